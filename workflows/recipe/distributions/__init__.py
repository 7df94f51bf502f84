"""Which values of a recipe are probability distributions?

Distributions that a recipe has in place of values, and the value that a run uses for each. Nothing
here checks a recipe or runs it at a draw, or infers a distribution from data.
Offers: `nominal_values.settle`, `nominal_values.Uncertain`, `shapes.Law`,
        `joint_distribution.Joint`.
"""
