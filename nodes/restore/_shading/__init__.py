"""How a smooth field of transmission, that of dirt and lens, is told from the scenes of several frames."""
