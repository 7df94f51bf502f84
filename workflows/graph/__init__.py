"""What is a checked recipe, and what happened to each of its steps in a run?

The graph of steps and wires, its final values and where each was written, and the records and errors of a run.
Nothing here reads a file, asks a cache or runs a step.
Offers: `recipe_graph.Recipe`, `recipe_graph.Step`, `recipe_graph.needed`, `final_values.Config`,
`diagnostics.Diagnostic`, `diagnostics.RecipeError`, `run_error.RunError`, `step_record.StepRecord`,
`step_record.Event`.
"""
