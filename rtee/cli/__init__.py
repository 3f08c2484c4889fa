"""The command ``rtee``: parse, call one function below, print."""

from rtee.cli.main import main

__all__ = ["main"]
