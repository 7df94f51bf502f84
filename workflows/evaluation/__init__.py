"""Which mask and restorer are better, over scenes and strengths of a laser?

Pipelines, scenes and points of an evaluation, intervals of confidence, and the page that compares.
Nothing here is trained; metrics are nodes.
Offers: `run_evaluation.evaluate`, `pipelines.read_pipelines`, `evaluation_result.Evaluated`.
"""
