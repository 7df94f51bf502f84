"""Which values are distributions, and what is a draw of them?

Scalar and joint distributions in the place of values, and the steps that read what is drawn.
Nothing here runs a recipe at a draw, or infers a distribution from data.
Offers: `nominal_values.settle`, `nominal_values.Uncertain`, `scalar.Law`, `joint.Joint`, `uncertain_inputs.Inputs`.
"""
