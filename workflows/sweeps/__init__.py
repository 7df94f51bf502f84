"""How do the numbers of a recipe change over its values?

Axes and their points, the order in which points share most, the runs and the table of them.
Nothing here prints: the screen of a sweep belongs to `cli`.
Offers: `sweep_run.sweep`, `sweep_run.Sweep`, `axes.read_axes`, `sweep_points.outcomes`.
"""
