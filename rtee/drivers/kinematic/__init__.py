"""A hand that follows its reference without any device: for display, development and tests."""
