"""Cells of a notebook, without a device: everything is simulated in this process."""

# %%
import rtee

opened = rtee.simulated("robotiq_2f_85", object="50mm")
hand = opened.__enter__()

# %%
result = hand.grasp("50mm", force="40N")
result

# %%
hand.take_away()
hand.wait(1.0)
[event.kind for event in hand.events]

# %%
opened.__exit__(None, None, None)
