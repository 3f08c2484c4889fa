"""Finding devices, saying what is wrong with them or the machine, twitching them."""
