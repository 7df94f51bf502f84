"""What are the parameters of a sensor, and how well do its frames determine these parameters?

The posterior of a sensor's parameters given its frames, the mode, ensembles of walkers, checks, and
the page. Likelihoods and priors are nodes. Only this package imports emcee.
Offers: `run_calibration.calibrate`, `log_posterior.SensorPosterior`, `log_posterior.find_mode`,
        `emcee_sampler.sample`.
"""
