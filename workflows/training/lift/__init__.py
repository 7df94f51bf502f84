"""How is a lift from RGB to spectra trained?

Pairs of pictures and spectra through a recipe, the iterations of the network, and its figures.
No mask and no restorer belongs here.
Offers: `lift_run.train_lift`, `lift_iteration.LiftLearner`.
"""
