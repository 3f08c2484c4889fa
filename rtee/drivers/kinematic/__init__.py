"""A hand that follows its reference without a device, for display, development and tests."""
