#!/usr/bin/env python3
"""Faults that tests must find: `python tests/mutants.py [WORD...]`, with words those whose file contains one of them.

Each mutant is one fault in one file: a constant, a sign, a limit that is off by one, a correction that is dropped, a
comparison that is turned round. Every mutant gets a temporary copy of the tree of its own, and there the tests that are
named beside the mutant must fail. Before, the same tests must pass on a copy without any fault. Two lines are printed
for each mutant: what became of it, and which test failed and how, for a test may fail for another reason. The exit
status is 1 where a mutant survives, where its tests cannot be run, or where its old text does not stand exactly once in
its file.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
_LINKED = ("nodes", "workflows", "recipes")  #: folders of the package, which .src/neusee links to
_SKIPPED = shutil.ignore_patterns("__pycache__", ".hypothesis")
_RESULTS = {0: "SURVIVED", 1: "killed"}  #: by the exit status of pytest


class Mutant(NamedTuple):
    file: str  #: relative to the root of the tree
    old: str  #: stands exactly once in the file
    new: str
    tests: str  #: files or identifiers of tests, apart by spaces: at least one of them fails


def within(room: str, *tests: str) -> str:
    """Return the named tests of one folder, apart by spaces."""
    return " ".join(f"tests/{room}/test_{test}" for test in tests)


MUTANTS = (
    # Faults that no test found once.
    Mutant(
        "nodes/sensor/_exposure.py",
        "share / (1.0 - share)",
        "share",
        within("nodes/sensor", "exposure.py::test_a_level_is_off_by_as_much_as_stated_where_the_brightest_pixel_is"),
    ),
    Mutant(
        "workflows/tolerance/error_propagation.py",
        " / max(1.0 - share, 1e-3)",
        "",
        within(
            "workflows/tolerance",
            "error_propagation.py::test_the_bound_is_a_share_of_what_is_left_and_not_of_what_was_left_out",
        ),
    ),
    Mutant(
        "workflows/studies/uncertainty/scatter_estimate.py",
        "/ (n - 2)",
        "/ (n - 1)",
        within(
            "workflows/studies/uncertainty",
            "uncertainty_study.py::test_the_error_of_a_deviation_is_that_of_leaving_out_one_draw_after_another",
        ),
    ),
    Mutant(
        "nodes/restore/_inverse/_wiener.py",
        "GREY = 0.95",
        "GREY = 0.30",
        within(
            "nodes/restore/inverse",
            "wiener.py::test_of_measured_colours_no_other_correlation_of_channels_tells_more_of_a_hidden_one",
        ),
    ),
    Mutant(
        "nodes/flare/_ghosts.py",
        "0.05 + 0.95 *",
        "0.5 + 0.5 *",
        within("nodes/flare", "ghosts.py::test_a_coating_reflects_as_a_quarter_wave_of_magnesium_fluoride"),
    ),
    Mutant(
        "nodes/flare/_ghosts.py",
        "400e-9 + 300e-9 *",
        "500e-9 + 100e-9 *",
        within("nodes/flare", "ghosts.py::test_coatings_are_tuned_to_all_of_the_visible_range"),
    ),
    Mutant(
        "workflows/keys/input_file_digest.py",
        "_SETTLED = 2_000_000_000",
        "_SETTLED = 200_000_000",
        within(
            "workflows/keys",
            "cache_key.py::test_a_file_that_is_written_twice_within_one_tick_of_its_stamp_is_read_twice",
        ),
    ),
    # Physics.
    Mutant(
        "nodes/sensor/_digitization.py",
        "dtype=torch.float32) - 0.5",
        "dtype=torch.float32)",
        within("nodes/sensor", "digitization.py::test_dithered_floor_agrees_with_its_reference"),
    ),
    Mutant(
        "nodes/sensor/_digitization.py",
        "flat[part].double() * gain",
        "(flat[part] * gain).double()",
        within("nodes/sensor", "digitization.py::test_no_number_is_further_from_the_exact_product_than_half"),
    ),
    Mutant(
        "nodes/sensor/_photon_transfer.py",
        "(1.0 / 6.0 if rounding",
        "(1.0 / 12.0 if rounding",
        within(
            "nodes/sensor",
            "photon_transfer.py::test_what_is_predicted_in_the_dark_is_measured_where_rounding_is_most_of_the_noise",
        ),
    ),
    Mutant(
        "nodes/sensor/_noise.py",
        "drawn / math.sqrt(darkest)",
        "drawn / darkest",
        within(
            "nodes/sensor",
            "noise.py::test_with_the_same_draws_other_light_has_a_noise_that_is_off_by_no_more_than_stated",
        ),
    ),
    Mutant(
        "nodes/sensor/_noise.py",
        "electrons.min + shift",
        "electrons.max + shift",
        within("nodes", "bounds.py::test_noise_of_numbers_below_zero_is_weighed_against_the_darkest"),
    ),
    Mutant(
        "nodes/optics/_laser_spot.py",
        "_LSR = 2.2",
        "_LSR = 0.9",
        within("nodes", "bounds.py::test_what_is_not_added_is_no_brighter_than_stated[spot-30]"),
    ),
    Mutant(
        "nodes/optics/_transform/_matrix_transform.py",
        "cosine[:, 0] /= 2",
        "cosine[:, 0] /= 1",
        within("nodes/optics/transform", "scaled_transform.py::test_every_method_is_the_double_sum[folded]"),
    ),
    Mutant(
        "nodes/optics/_transform/_pupil_field.py",
        "_FEW_TURNS = 2.0",
        "_FEW_TURNS = 2e9",
        within("nodes/optics", "psf_independent.py::test_without_a_compiler_the_error_is_as_stated_too"),
    ),
    Mutant(
        "nodes/optics/_transform/_pupil_field.py",
        "torch.add(self.tilt_u[columns], turns, alpha=self.view.turns_height, out=turns)",
        "torch.add(self.tilt_u[columns], (self.screens.height[rows, columns] * self.view.turns_height), out=turns)",
        within("nodes/optics", "psf_independent.py::test_without_a_compiler_the_error_is_as_stated_too"),
    ),
    Mutant(
        "nodes/optics/_transform/_field.h",
        "        turns.part[i] = t - ((t + Kind<double>::round) - Kind<double>::round);",
        "        turns.part[i] = __builtin_convertvector(__builtin_convertvector(t, Eight), Turns);",
        within("nodes/optics/transform", "fused.py::test_a_phase_of_many_turns_is_exact"),
    ),
    Mutant(
        "nodes/optics/_phase_steps.py",
        "    height, path = ((b - a)[inside] for a, b in zip(one[:2], other[:2], strict=True))",
        "    height, path = (((b * 2e6 - a * 2e6) / 2e6)[inside] for a, b in zip(one[:2], other[:2], strict=True))",
        within("nodes/optics", "pupil.py::test_phase_steps_on_a_thick_plate_are_exact"),
    ),
    Mutant(
        "nodes/metrics/_psf_contrast.py",
        "torch.fft.rfft2(kernel.double())",
        "torch.fft.rfft2(kernel.float()).to(torch.complex128)",
        within("nodes", "double_precision.py::test_the_error_in_float64"),
    ),
    Mutant(
        "nodes/metrics/_suppression_ratios.py",
        "1.0 - inside / through.where(~dark, 1.0)",
        "1.0 - inside",
        within("nodes/metrics", "background_share.py::test_the_light_outside_is_what_passes_and_misses_the_window"),
    ),
    Mutant(
        "nodes/metrics/_spectral_error.py",
        "(weights[:, 1:] + weights[:, :-1]) / 2], 1) / 2",
        "(weights[:, 1:] + weights[:, :-1]) / 2], 1) / 4",
        within("nodes/metrics", "spectral_error.py::test_a_white_point"),
    ),
    Mutant(
        "nodes/spectra/_channel_responses.py",
        "    if not len(unseen):",
        "    if len(unseen):",
        within("workflows/cli", "found_before_run.py::test_a_laser_that_no_channel_sees_is_noted_with_the_response"),
    ),
    Mutant(
        "nodes/scene/_exr_picture.py",
        '(["R", "G", "B"], ["X", "Y", "Z"], ["Y"])',
        '(["R", "G", "B"], ["Y"])',
        within("nodes/scene", "exr_picture.py::test_channels_x_y_and_z_are_cie_xyz"),
    ),
    Mutant(
        "nodes/scene/_exr_picture.py",
        "opened.channels(number)",
        "opened.channels(0)",
        within("nodes/scene", "exr_picture.py::test_the_part_with_the_picture_is_found_or_chosen_by_name"),
    ),
    Mutant(
        "nodes/scene/_cube_files.py",
        "    if np.iscomplexobj(values):",
        "    if False:",
        within(
            "nodes/scene", "hyperspectral.py::test_a_complex_cube_of_matlab_is_refused_although_its_header_says_double"
        ),
    ),
    Mutant(
        "workflows/training/training_recipe.py",
        '"precision": "double"',
        '"precision": "single"',
        within("workflows/training", "training_precision.py::test_the_loss_in_float64_has_no_step_of_single_precision"),
    ),
    Mutant(
        "workflows/training/training_iteration.py",
        "largest = math.inf if self.settings.clip is None else self.settings.clip",
        "largest = 10.0",
        within(
            "workflows/training", "training_precision.py::test_the_gradient_of_each_module_has_at_most_the_norm_clip"
        ),
    ),
    Mutant(
        "workflows/training/lift/lift_iteration.py",
        "largest = math.inf if self.settings.clip is None else self.settings.clip",
        "largest = 10.0",
        within("workflows/training/lift", "lift_run.py::test_the_gradient_of_all_weights_has_at_most_the_norm_clip"),
    ),
    Mutant(
        "recipes/hdr_night.yaml",
        "  - restore: richardson_lucy ",
        "  - restore: wiener ",
        within("workflows/simulation", "hdr_night.py::test_a_small_picture_gains_from_the_restoration_of_the_recipe"),
    ),
    Mutant(
        "recipes/reading/as_printed.yaml",
        "  c1: 0.2 ",
        "  c1: 0 ",
        within("workflows/recipe", "paper_as_printed.py::test_the_noise_is_that_of_the_printed_formulas"),
    ),
    Mutant(
        "nodes/spectra/_illuminant.py",
        "- bands.widths / 2",
        "- bands.widths",
        within(
            "nodes/spectra", "illuminant.py::test_bands_up_to_the_ends_of_a_table_have_light_and_bands_beyond_have_none"
        ),
    ),
    Mutant(
        "nodes/flare/_dirt.py",
        "rms * draw / draw.norm()",
        "rms * draw",
        within("nodes/flare", "dirt.py::test_soft_kinds_have_the_asked_strength"),
    ),
    Mutant(
        "nodes/calibrate/_emva_fit.py",
        "_QUANTIZATION = 1.0 / 12.0",
        "_QUANTIZATION = 0.0",
        within("nodes/calibrate", "emva_fit.py::test_exact_levels_give_the_exact_camera"),
    ),
    Mutant(
        "nodes/calibrate/_likelihood/_linear_sensor.py",
        "(levels.degrees_of_freedom + 1) * variance.log()",
        "levels.degrees_of_freedom * variance.log()",
        within(
            "nodes/calibrate/likelihood",
            "likelihood_node.py::test_what_it_says_of_two_sensors_is_what_every_pixel_says",
        ),
    ),
    Mutant(
        "nodes/restore/_inverse/_lowest_frequencies.py",
        "step[:, 0] *= 2.0",
        "step[:, 0] *= 1.0",
        within("nodes/restore/inverse", "hidden_pixels.py::test_the_lowest_frequencies_are_inverted_exactly"),
    ),
    Mutant(
        "nodes/restore/_inverse/_masked_blur.py",
        "count[-1] = 1.0",
        "count[-1] = 2.0",
        within("nodes/losses", "wiener_loss.py::test_it_agrees_with_its_reference"),
    ),
    Mutant(
        "nodes/metrics/_picture_quality.py",
        "eps=0.0",
        "eps=1e-12",
        within("nodes", "kornia_and_colour.py::test_dark_pictures_are_as_alike_as_scikit_image_says"),
    ),
    Mutant(
        "nodes/doe/_fabrication_limits.py",
        "(waves + rounded_up + 0.5 / levels)",
        "(waves + rounded_up)",
        within("nodes", "bounds.py::test_what_is_left_out_changes_no_more_than_stated[fabricate-30]"),
    ),
    Mutant(
        "nodes/input_files.py",
        "rows * columns > PIXELS",
        "rows * columns >= PIXELS",
        within("workflows/cli", "limits.py::test_a_file_at_the_limit_is_read_and_a_larger_one_is_refused"),
    ),
    Mutant(
        "nodes/input_files.py",
        "count > VALUES",
        "count > VALUES + 1",
        within("workflows/cli", "limits.py::test_arrays_and_tables_at_the_shipped_limits"),
    ),
    Mutant(
        "nodes/scene/_large_picture.py",
        "(old / new) - 0.5)",
        "(old / new))",
        within("nodes/scene", "large_picture.py::test_bands_of_rows_give_the_light_of_the_whole_picture"),
    ),
    Mutant(
        "nodes/calibrate/_frames/_damaged_frames.py",
        "end > (size := file.stat().st_size)",
        "end > (size := file.stat().st_size) + 4000",
        within("workflows/cli", "limits.py::test_fits_frames_are_opened_before_the_run"),
    ),
    # The engine, and what is built on it.
    Mutant(
        "workflows/keys/cache_key.py",
        "[seed, step.name,",
        "[step.name,",
        within("workflows/keys", "cache_key.py::test_a_name_or_a_seed_counts_for_noise_alone"),
    ),
    Mutant(
        "workflows/store/budget_eviction.py",
        "freed - candidate.size >= excess",
        "freed - candidate.size > excess",
        within(
            "workflows/store",
            "budget_eviction.py::test_a_value_stays_where_those_that_go_make_just_enough_room_without_it",
        ),
    ),
    Mutant(
        "workflows/store/lease.py",
        "now - since > WINDOW",
        "now - since > 0",
        within("workflows/store", "lease.py::test_a_foreign_holder_is_dead_after_a_window_without_a_heartbeat"),
    ),
    Mutant(
        "workflows/tolerance/skip_decision.py",
        "bound <= tolerance",
        "bound < tolerance",
        within(
            "workflows/tolerance",
            "error_propagation.py::test_what_changes_nothing_is_left_out_where_nothing_is_allowed",
        ),
    ),
    Mutant(
        "workflows/tolerance/error_budget.py",
        "1.0 - 2 * CHANNELS",
        "1.0 - CHANNELS",
        within(
            "workflows/tolerance",
            "error_propagation.py::test_of_the_tolerance_of_a_recipe_with_economies_half_is_theirs",
        ),
    ),
    Mutant(
        "workflows/engine/cost_model.py",
        'fits = _kind(row) != "cpu" or',
        'fits = _kind(row) == "cpu" or',
        within("workflows/engine", "cost_model.py::test_a_peak_that_this_machine_cannot_have_is_passed_over"),
    ),
    Mutant(
        "workflows/engine/cost_model.py",
        "_NEWEST = 5",
        "_NEWEST = 50",
        within("workflows/engine", "cost_model.py::test_only_the_newest_count"),
    ),
    Mutant(
        "workflows/engine/load_or_recompute.py",
        "load > compute + _GAIN",
        "load > compute - _GAIN",
        within("workflows/engine", "load_or_recompute.py::test_a_millisecond_is_not_worth_a_look"),
    ),
    Mutant(
        "workflows/placement/memory_profile.py",
        "[-1]) + 1",
        "[-1])",
        within("workflows/placement", "heft_schedule.py::test_no_schedule_breaks_a_rule"),
    ),
    Mutant(
        "workflows/placement/task_priorities.py",
        "held + graph.own[i] + ",
        "held + ",
        within("workflows/placement", "heft_schedule.py::test_no_other_depth_first_order_of_a_tree_holds_less"),
    ),
    Mutant(
        "workflows/studies/accuracy/pareto_line.py",
        "point.most < line",
        "point.most > line",
        within("workflows/studies/accuracy", "accuracy_study.py::test_the_pareto_line_has_what_no_other_point_beats"),
    ),
    Mutant(
        "workflows/studies/uncertainty/sobol_indices.py",
        " / (1.0 - (q**2).sum(1)).clip(1e-9)",
        "",
        within(
            "workflows/studies/uncertainty",
            "uncertainty_study.py::test_a_polynomial_is_judged_by_draws_that_it_has_not_seen",
        ),
    ),
    Mutant(
        "workflows/studies/calibration/rank_uniformity.py",
        "_CHANCE / parameters",
        "_CHANCE",
        within(
            "workflows/studies/calibration",
            "calibration_study.py::test_many_parameters_together_raise_no_more_false_alarms_than_one",
        ),
    ),
    Mutant(
        "workflows/sweeps/value_ranges.py",
        "math.ceil((stop - start) / step)",
        "math.floor((stop - start) / step)",
        within("workflows/sweeps", "axes.py::test_values_as_they_are_written"),
    ),
    Mutant(
        "workflows/sweeps/point_order.py",
        "if n % 2 == 0",
        "if n % 2 == 2",
        within("workflows/sweeps", "point_order.py::test_no_order_of_a_small_sweep_needs_less"),
    ),
    Mutant(
        "workflows/evaluation/confidence_intervals.py",
        ", count - 1)) * spread",
        ", count)) * spread",
        within("workflows/evaluation", "run_evaluation.py::test_an_interval_is_that_of_students_table"),
    ),
)


def places(mutant: Mutant) -> int:
    """Return how often the old text of a mutant stands in its file."""
    return (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.old)


def copied(to: Path) -> Path:
    """Copy the tree into a new folder, with links to the folders of the package, and return the folder."""
    for name in (*_LINKED, "tests"):
        shutil.copytree(ROOT / name, to / name, ignore=_SKIPPED)
    shutil.copy(ROOT / "pyproject.toml", to)
    shutil.copytree(ROOT / ".src", to / ".src", ignore=shutil.ignore_patterns("__pycache__", *_LINKED))
    for name in _LINKED:
        (to / ".src/neusee" / name).symlink_to(Path("../..") / name)
    return to


def tested(tree: Path, tests: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run the named tests in a copy of the tree until one fails."""
    own = {"PYTHONPATH": str(tree / ".src"), "NEUSEE_CACHE": str(tree / "cache"), "COLUMNS": "400"}
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests],
        cwd=tree,
        env={**os.environ, **own},
        capture_output=True,
        text=True,
    )


def became(mutant: Mutant) -> tuple[str, str]:
    """Return what became of a mutant (killed, SURVIVED, or why nobody can tell), and the test that failed and how."""
    if (count := places(mutant)) != 1:
        return f"STANDS {count} TIMES", ""
    with tempfile.TemporaryDirectory() as folder:
        tree = copied(Path(folder) / "tree")
        file = tree / mutant.file
        file.write_text(file.read_text(encoding="utf-8").replace(mutant.old, mutant.new), encoding="utf-8")
        done = tested(tree, mutant.tests.split())
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return _RESULTS.get(done.returncode, f"NOT RUN (pytest ended with {done.returncode})"), "".join(failed[-1:])


def sound(mutants: Sequence[Mutant]) -> bool:
    """Return whether the tests of these mutants pass where there is no fault; print why where they do not."""
    tests = list(dict.fromkeys(test for mutant in mutants for test in mutant.tests.split()))
    with tempfile.TemporaryDirectory() as folder:
        done = tested(copied(Path(folder) / "tree"), tests)
    if done.returncode:
        print(done.stdout, done.stderr, sep="\n")
    return not done.returncode


def main(words: Sequence[str]) -> int:
    """Try every mutant whose file contains one of the words, and return the exit status."""
    mutants = [m for m in MUTANTS if not words or any(word in m.file for word in words)]
    if not mutants:
        print(f"no mutant is in a file that contains {' or '.join(words)}")
        return 1
    if not sound(mutants):
        print("these tests fail without any fault: no mutant was tried")
        return 1
    killed = 0
    for mutant in mutants:
        began, (what, how) = time.monotonic(), became(mutant)
        killed += what == "killed"
        print(f"{what:8}  {time.monotonic() - began:5.1f} s  {mutant.file}: {mutant.old} -> {mutant.new}")
        print(f"          {how}", flush=True)
    print(f"{killed} of {len(mutants)} mutants killed")
    return int(killed < len(mutants))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
