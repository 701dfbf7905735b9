"""The vehicle interface: the only process that writes to the car's bus. It trusts nothing."""
