"""Why did a step run again, and what would a run do?

Reasons in words for what runs again, and forecasts of a run without running it.
Nothing here computes a step.
Offers: `why_rerun.explained`, `why_rerun.why_lines`, `run_forecast.planned`.
"""
