"""A driver; hand.yaml has `driver: jaw_driver:JawDriver` and `options: {host: …, port: 4000}`."""

import asyncio

from rtee import monotonic
from rtee.drivers.base import Driver
from rtee.sample import ActuatorState
from rtee.types import Reference


class JawDriver(Driver):
    async def configure(self) -> None:
        where = self.spec.options["host"], self.spec.options["port"]
        self.reader, self.writer = await asyncio.open_connection(*where)

    async def sense(self) -> ActuatorState:
        self.writer.write(b"?\n")
        answer = await self.reader.readuntil(b"\n")
        return ActuatorState.measured([float(answer) / 1000], monotonic.now())

    async def move(self, reference: Reference) -> None:
        self.writer.write(b"! %.1f\n" % (reference.position[0] * 1000))
