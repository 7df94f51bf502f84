"""Sensor: photons to electrons to digital numbers."""
