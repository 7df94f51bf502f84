"""A checked recipe as text: its contents, the lines before a run, and its final values as YAML."""

from __future__ import annotations

from typing import Any

from neusee.workflows.graph.recipe_graph import Recipe
from neusee.workflows.report.paper_readings import consequences


def contents_of(recipe: Recipe) -> dict[str, Any]:
    """Return the title of a recipe, its numbers of steps, nodes and parameters, its outputs and
    its notes.
    """
    nodes = {step.node.path for step in recipe.steps.values()}
    values = sum(len(step.params) for step in recipe.steps.values())
    sizes = {"steps": len(recipe.steps), "nodes": len(nodes), "parameters": values}
    return {
        "recipe": recipe.name,
        "title": recipe.title,
        **sizes,
        "outputs": recipe.outputs,
        "notes": recipe.notes,
    }


def opening(recipe: Recipe, command: str) -> list[str]:
    """Return the lines to print before a run: recipe title, numbers of checked steps and
    parameters, and notes.
    """
    counts = contents_of(recipe)
    sizes_text = (
        f"{counts['steps']} steps of {counts['nodes']} nodes, {counts['parameters']} parameters"
    )
    notes = [f"note     {line}" for line in (*recipe.notes, *consequences(recipe.config.values))]
    return [
        f"neusee {command}: {recipe.title or recipe.name}",
        f"checked  {sizes_text}: all right",
        *notes,
    ]


def recipe_text(recipe: Recipe) -> str:
    """Return the recipe as YAML that can be run again: all final values, with the source of each
    as a comment.
    """
    head = (
        f"# {recipe.title or recipe.name}\n# Final values; the comment after each value names its"
        " source.\n"
    )
    return head + recipe.config.to_yaml()
