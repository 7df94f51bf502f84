"""Diffractive optical elements: height maps and materials."""
