"""Which values of a recipe are probability distributions, and how are they drawn?

Distributions of one or several values, written in place of the values, and the parameters that read drawn values.
Nothing here runs a recipe at a draw, or infers a distribution from data.
Offers: `nominal_values.settle`, `nominal_values.Uncertain`, `scalar.Law`, `joint.Joint`, `uncertain_inputs.Inputs`.
"""
