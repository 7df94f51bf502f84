"""Spectra: bands, lines, lifts from RGB, illuminants and responses."""
