"""The hands RH56 of Inspire Robots."""
