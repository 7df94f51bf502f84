"""How is a network trained to estimate spectra from RGB?

Pairs of pictures and spectra from a recipe, the iterations of the training, and its figures.
No mask and no restorer belongs here.
Offers: `lift_run.train_lift`, `lift_iteration.LiftLearner`.
"""
