"""What does a checked recipe contain, and what happened to each step in a run?

The graph of steps and their connections, the final values with their sources, and the records and
errors of a run. Nothing here reads a file, looks up a result in the cache or runs a step.
Offers: `recipe_graph.Recipe`, `recipe_graph.Step`, `recipe_graph.needed`, `final_values.Config`,
        `errors.Diagnostic`, `errors.RecipeError`, `errors.RunError`,
        `recipe_graph.StepRecord`, `recipe_graph.Event`.
"""
