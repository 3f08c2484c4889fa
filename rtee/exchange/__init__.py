"""Export of hands as URDF, SRDF and MJCF, and import of MJCF and xacro files."""
