"""The command ``rtee``: parse, call one function below, print."""

try:
    from rtee.cli.main import main
except KeyboardInterrupt:  # Ctrl-C while modules are read
    raise SystemExit(130) from None

__all__ = ["main"]
