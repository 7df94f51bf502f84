"""Which values of a recipe are probability distributions, and how are numbers sampled from them?

Distributions that a recipe has in place of values, draws from them, and the parameters that read
the drawn values. Nothing here runs a recipe at a draw, or infers a distribution from data.
Offers: `nominal_values.settle`, `nominal_values.Uncertain`, `shapes.Law`,
        `joint_distribution.Joint`, `uncertain_inputs.Inputs`.
"""
