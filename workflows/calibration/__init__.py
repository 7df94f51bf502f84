"""Which constants does a sensor have, and how well do its frames determine them?

The posterior of a sensor from frames, its mode, ensembles of walkers, checks of both, and the page.
Likelihoods and priors are nodes. This room alone imports emcee.
Offers: `run_calibration.calibrate`, `log_posterior.SensorPosterior`, `posterior_mode.find_mode`,
`emcee_sampler.sample`.
"""
