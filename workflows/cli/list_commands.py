"""The commands that list what there is: recipes, nodes, the schema of recipes."""

from __future__ import annotations

from typing import Annotated

import typer

from neusee.workflows.cli.command_frame import fail, say


def recipes() -> None:
    """List the recipes and the groups that they choose from."""
    from neusee.workflows.cli.catalogue import recipe_lines

    say(recipe_lines())


def nodes(
    name: Annotated[str | None, typer.Argument(help="One node, such as optics.psf; `reading`, or `glossary`.")] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show where in the code an error arose.")] = False,
) -> None:
    """List the nodes, or explain one of them.

    For one node: its physics, source, error, inputs and parameters, and the recipes that use it. `reading` lists how
    the paper is read where it contradicts itself. `glossary` lists the terms of the field, one a line.
    """
    from neusee.workflows.cli import catalogue

    try:
        say(catalogue.node_lines(name) if name else catalogue.nodes_lines())
    except LookupError as error:
        fail(str(error.args[0]))


def schema() -> None:
    """Print the JSON schema of recipes for editors."""
    import json

    from neusee.workflows.recipe.json_schema import schema as of_recipes

    say([json.dumps(of_recipes(), indent=1)])
