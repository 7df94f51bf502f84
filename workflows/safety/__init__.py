"""Is the sensor damaged or dazzled by this laser, from which distance, and how sure is that?

The recipe says the laser, its distance, the lens and the sensor; the formulas are in
`neusee.nodes.laser`, and steps of the recipe compute what a mask does to the peak. Nothing here
certifies safety, and nothing here prints.
Offers: `safety_estimate.estimate`, `run_safety.assess`, `safety_text.lines`.
"""
