"""Hands as nodes of a ROS 2 graph, over Zenoh with rmw_zenoh's protocol, without ROS itself."""

from rtee.ros2.node import Context, Node
from rtee.ros2.qos import DEFAULT, LATCHED, PARAMETERS, ROSOUT, SENSOR_DATA, Qos
from rtee.ros2.types import ActionType, ServiceType, TopicType, interfaces

__all__ = [
    "DEFAULT",
    "LATCHED",
    "PARAMETERS",
    "ROSOUT",
    "SENSOR_DATA",
    "ActionType",
    "Context",
    "Node",
    "Qos",
    "ServiceType",
    "TopicType",
    "interfaces",
]
