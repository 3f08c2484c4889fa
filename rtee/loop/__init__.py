"""The online half: clock, executor, set-point profiles, devices' supervision, safety."""
