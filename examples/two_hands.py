"""Grasp with two hands at once; if one fails, the other brakes; `rtee run` runs both."""

import anyio

import rtee


async def hold(name: str, action: str) -> None:
    async with rtee.connect(name, wait="10s") as hand:
        result = await hand.do(action)
        print(name, result.outcome)
        if not result.succeeded:
            raise RuntimeError(f"{name} does not hold its side")


async def main() -> None:
    # However the group ends, by an error, a timeout or Ctrl-C, goals still running are cancelled.
    with anyio.fail_after(20.0):
        async with anyio.create_task_group() as group:
            group.start_soon(hold, "robotiq_2f_85", "Grasp")
            group.start_soon(hold, "schunk_svh", "Grasp")


anyio.run(main)
