"""Make an action of others, and do it; `rtee run schunk_svh` runs already."""

import rtee

with rtee.connect_blocking("schunk_svh", wait="10s") as hand:
    hand.add_composed("hook", ["trig:index", "trig:middle", "trig:ring*0.8"], replace=True)
    result = hand.do("hook", intensity=0.7)
    print(result.outcome, {name: round(at, 2) for name, at in result.position.items()})
    hand.remove_action("hook")
