"""LinkerHand O6 and L10 of Linkerbot: Modbus RTU on RS-485, or CAN."""
