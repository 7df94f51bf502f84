"""Why did a step run again, and what would a run do?

Reasons why a step runs again, and forecasts of the steps, the time and the memory of a run.
Nothing here computes a step.
Offers: `why_rerun.explained`, `why_rerun.why_lines`, `run_forecast.planned`.
"""
