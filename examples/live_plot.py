"""Draw the positions of a hand as they come; `rtee run schunk_svh` runs already."""

from collections import deque

import matplotlib.pyplot as plt

import rtee

SECONDS = 2.0

with rtee.connect_blocking("schunk_svh", wait="10s") as hand:
    begin = hand.state().stamp
    seen: deque[rtee.State] = deque(maxlen=500)
    for state in hand.states(rate=20):  # always the newest, however long drawing takes
        seen.append(state)
        plt.cla()
        plt.plot([s.stamp - begin for s in seen], [s.position for s in seen])
        plt.legend(state.names, fontsize="xx-small")
        plt.pause(0.001)
        if state.stamp - begin > SECONDS:
            break
