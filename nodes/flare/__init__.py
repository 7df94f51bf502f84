"""Flare: dirt in the pupil and ghosts on the sensor."""
