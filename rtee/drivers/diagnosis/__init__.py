"""Find devices, diagnose them and the computer, and twitch them."""
