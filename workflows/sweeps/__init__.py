"""How do the results of a recipe change when its parameters change?

The axes of a sweep, its points, the order in which the points run, the runs and the table of
results. Nothing here prints: `cli` prints the progress of a sweep.
Offers: `sweep_run.sweep`, `sweep_run.Sweep`, `axes.read_axes`, `sweep_points.outcomes`.
"""
