"""The HERI II on EtherCAT."""
