"""Memory of the report, which counts in the limit of a run."""

from neusee.workflows.engine.local_executor import lanes_of, program_memory
from neusee.workflows.explain.report_memory import shown_steps
from neusee.workflows.explain.run_forecast import planned
from neusee.workflows.recipe.loading import load
from neusee.workflows.store.result_store import Store


def test_the_steps_that_pictures_and_files_show_are_found_and_parameters_are_not():
    found = shown_steps(load("first_light", []))
    assert {"radiance", "psf[plain]", "psf[mask]", "spot[plain,green]", "raw[mask]", "restored"} <= set(found)
    assert not [name for name in found if "." in name or "()" in name or "*" in name]


def test_a_limit_that_suffices_for_the_steps_and_not_for_the_report_is_refused(tmp_path):
    recipe = load("paper_table1", [])
    free = planned(recipe, Store(tmp_path), lanes_of(["cpu"], 10**11))
    assert free.refused == ""
    assert free.reporting > free.running > program_memory()
    between = int((free.reporting + free.running) / 2)
    tight = planned(recipe, Store(tmp_path), lanes_of(["cpu"], between))
    assert "the report needs" in tight.refused
    assert "the limit is" in tight.refused


def test_a_larger_picture_needs_more_for_steps_and_report(tmp_path):
    sizes = (["scene.shape=[400,400]", "sensor.shape=[320,320]"], [], ["scene.shape=[1000,1000]"])
    plans = [planned(load("first_light", changes), Store(tmp_path), lanes_of(["cpu"], 10**11)) for changes in sizes]
    assert plans[0].running < plans[2].running
    assert plans[0].reporting < plans[1].reporting < plans[2].reporting
