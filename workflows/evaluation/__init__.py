"""How are masks and restorers compared over many scenes and laser strengths?

Pipelines, scenes and points of an evaluation, confidence intervals, and the page of the comparison.
Nothing here is trained; metrics are nodes.
Offers: `run_evaluation.evaluate`, `pipelines.read_pipelines`,
        `evaluation_result.EvaluationResult`.
"""
