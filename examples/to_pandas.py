"""A recording as a table: how far each actuator lags behind its reference."""

import sys

from rtee.log import read, to_pandas

recording = read(sys.argv[1] if len(sys.argv) > 1 else "logs")
measured = to_pandas(recording).filter(like="position.")
reference = to_pandas(recording, "reference").filter(like="position.")
lag = (measured - reference.reindex(measured.index, method="nearest")).abs()
print(lag.describe().T[["mean", "max"]])
print(to_pandas(recording, "results").filter(["action", "outcome", "duration"]))
