"""Modules that the program imports when a command first uses them, all in one place.

To import one takes from 0.04 s (typer, pydantic) to more than a second (torch), and many commands
need few of them: ``neusee --help`` none, ``neusee recipes`` no torch. Whatever is quicker is
imported at the top of the file that uses it, but for what ``neusee --help`` would import.

    from neusee.workflows.cli import lazy_imports as lazy
    lazy.simulate_recipe.simulate(recipe, store, ...)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neusee.nodes import calibrate as calibrate
    from neusee.nodes import own_modules as own_modules
    from neusee.nodes import units as units
    from neusee.workflows.api import verbs as verbs
    from neusee.workflows.calibration import calibration_page as calibration_page
    from neusee.workflows.calibration import emva_sheet as emva_sheet
    from neusee.workflows.calibration import run_calibration as run_calibration
    from neusee.workflows.calibration import run_sheet as run_sheet
    from neusee.workflows.cli import command_frame as command_frame
    from neusee.workflows.cli import handbook_reference as handbook_reference
    from neusee.workflows.cli import program_options as program_options
    from neusee.workflows.cli import repetition as repetition
    from neusee.workflows.cli import sweep_screen as sweep_screen
    from neusee.workflows.comparison import comparison_report as comparison_report
    from neusee.workflows.comparison import run_record as run_record
    from neusee.workflows.contract import node_contract as node_contract
    from neusee.workflows.engine import dask_cluster as dask_cluster
    from neusee.workflows.engine import local_executor as local_executor
    from neusee.workflows.engine import machine_resources as machine_resources
    from neusee.workflows.engine import wanted_steps as wanted_steps
    from neusee.workflows.evaluation import pipelines as pipelines
    from neusee.workflows.explain import run_forecast as run_forecast
    from neusee.workflows.explain import stored_origin as stored_origin
    from neusee.workflows.explain import why_rerun as why_rerun
    from neusee.workflows.frames import folder_recipe as folder_recipe
    from neusee.workflows.frames import sensor_group as sensor_group
    from neusee.workflows.graph import errors as errors
    from neusee.workflows.graph import recipe_graph as recipe_graph
    from neusee.workflows.handbook import json_schema as json_schema
    from neusee.workflows.recipe import loading as loading
    from neusee.workflows.recipe import node_families as node_families
    from neusee.workflows.recipe import remembered_checks as remembered_checks
    from neusee.workflows.report import checked_recipe as checked_recipe
    from neusee.workflows.report import console as console
    from neusee.workflows.report import study_report as study_report
    from neusee.workflows.restoration import frame_recipes as frame_recipes
    from neusee.workflows.safety import run_safety as run_safety
    from neusee.workflows.safety import safety_text as safety_text
    from neusee.workflows.simulation import simulate_recipe as simulate_recipe
    from neusee.workflows.studies import run_study as run_study
    from neusee.workflows.tolerance import cheaper_steps as cheaper_steps
    from neusee.workflows.training import process_mesh as process_mesh
    from neusee.workflows.training import resumable_loop as resumable_loop
    from neusee.workflows.training import training_forecast as training_forecast

#: modules below neusee
_MODULES = (
    "nodes.calibrate",
    "nodes.own_modules",
    "nodes.units",
    "workflows.api.verbs",
    "workflows.calibration.calibration_page",
    "workflows.calibration.emva_sheet",
    "workflows.calibration.run_calibration",
    "workflows.calibration.run_sheet",
    "workflows.cli.command_frame",
    "workflows.cli.handbook_reference",
    "workflows.cli.program_options",
    "workflows.cli.repetition",
    "workflows.cli.sweep_screen",
    "workflows.comparison.comparison_report",
    "workflows.comparison.run_record",
    "workflows.contract.node_contract",
    "workflows.engine.dask_cluster",
    "workflows.engine.local_executor",
    "workflows.engine.machine_resources",
    "workflows.engine.wanted_steps",
    "workflows.evaluation.pipelines",
    "workflows.explain.run_forecast",
    "workflows.explain.stored_origin",
    "workflows.explain.why_rerun",
    "workflows.frames.folder_recipe",
    "workflows.frames.sensor_group",
    "workflows.graph.errors",
    "workflows.graph.recipe_graph",
    "workflows.handbook.json_schema",
    "workflows.recipe.loading",
    "workflows.recipe.node_families",
    "workflows.recipe.remembered_checks",
    "workflows.report.console",
    "workflows.report.checked_recipe",
    "workflows.report.study_report",
    "workflows.restoration.frame_recipes",
    "workflows.safety.run_safety",
    "workflows.safety.safety_text",
    "workflows.simulation.simulate_recipe",
    "workflows.studies.run_study",
    "workflows.tolerance.cheaper_steps",
    "workflows.training.process_mesh",
    "workflows.training.resumable_loop",
    "workflows.training.training_forecast",
)
_BY_NAME = {module.rpartition(".")[2]: module for module in _MODULES}


def __getattr__(name: str) -> Any:
    """Import a module when it is first used."""
    if name not in _BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"neusee.{_BY_NAME[name]}")
