"""The stand-ins of large commands: how a test runs what the README and the guide tell a reader to
type.

A command runs as it stands, or as a stand-in: the same words with small sizes, counts and machines
instead of the large ones. `STAND_INS` says which words change and why; `NotDeclared` is raised for
a large command without a stand-in.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from neusee.workflows.calibration.emva_figures import PICTURES
from neusee.workflows.evaluation.pipelines import CASES as LASERS
from neusee.workflows.evaluation.pipelines import NONE
from neusee.workflows.studies import stability_study
from neusee.workflows.studies.extreme_cases import CASES
from neusee.workflows.studies.left_out_steps import omissions
from tests.drawn_chains import drawn_chains
from tests.guide_commands import ROOT

SMALL_LENS = "optics: {samples: 128, pitch: 63.11 um, window: [48, 48], bands: 9}"
SMALL_SENSOR = "sensor: {shape: [24, 24]}"
#: options of packaged groups that a small option of the same name hides
SMALL_OPTIONS = {
    **{f"optics/{name}": SMALL_LENS for name in ("small", "neusee")},
    "sensor/small": SMALL_SENSOR,
    **{f"scene/{name}": "scene: {shape: [28, 28]}" for name in ("china", "siemens", "night")},
}
#: of a small camera
LARGEST = {"optics.samples": 128, "optics.bands": 31, "scene.shape": 96, "sensor.shape": 64}

#: in a recipe that takes its optics from an option of the package
OF_PACKAGE = re.compile(r"\boptics: [a-z]")

#: commands that compute little or nothing, and run as they are written
LIGHT = (
    "validate", "plan", "why", "config", "recipes", "nodes", "new", "init", "check", "schema", "cache", "compare",
    "handbook",
)  # fmt: skip
#: commands that run as they are written, but for the small options that hide those of the packaged
#: camera
SIZED = ("run", "sweep", "restore")


class NotDeclared(LookupError):
    """Error for a command of a page that is too large for a test and has no stand-in."""


class StandIn(NamedTuple):
    """Small sizes, counts and machines with which a test runs a command of a page, and the
    reason.
    """

    why: str
    more: tuple[str, ...] = ()  #: words after those of the page
    instead: Mapping[str, str] = {}  #: words in the place of words of the page
    #: ``module:name`` of a number of the program that is made small
    constants: Mapping[str, Any] = {}
    processes: int = 1  #: of `torchrun`
    code: int = 0  #: the exit code


PITCH = "doe.pitch=14.96 um"
FULL_MASK = StandIn("the height map has the 540 samples of the full pupil", more=(PITCH,))
FIELD = {
    "sensor.shape=[512,512]": "sensor.shape=[24,24]",
    "scene.shape=[576,576]": "scene.shape=[28,28]",
}
PIPELINES = "flat+none, half_ring+wiener, pixelwise@mask.npy+wiener"
EVALUATE = 'evaluate first_light "sensor.shape=[512,512]" "scene.shape=[576,576]"'
SIX = "train train_small train.stages.1.iterations=6 train.stages.2.iterations=6"
SHORT = {
    f"train.stages.{stage}.iterations=6": f"train.stages.{stage}.iterations=1" for stage in (1, 2)
}
ONE = tuple(SHORT.values())
TRAINING = (
    "optics.samples=48",
    "optics.pitch=168.27 um",
    "optics.bands=5",
    "optics.window=[40, 40]",
    "scene.shape=[40, 40]",
    "sensor.shape=[32, 32]",
    "train.network.width=4",
    "train.critics.width=4",
)
LIMITED = (
    "train.mask={kind: polynomial, learn_stop: true, limit: 0.01, weights: {filtered_error: 1, lsr:"
    " 0, bsr: 0}}"
)
PAPER_TRAINING = (
    *TRAINING,
    *ONE,
    "train.size=null",
    "train.stages.1.batch=2",
    "train.stages.2.batch=2",
)
DEMONSTRATION = (
    *TRAINING[:-2],
    "train.network.width=4",
    "train.mask.iterations=2",
    "train.stages.2.iterations=1",
    "train.pool=2",
    "train.size=null",
)
NIGHT = {
    "train.stages.1.iterations=3000": "train.stages.1.iterations=1",
    "train.stages.2.iterations=8000": "train.stages.2.iterations=1",
}
SMALLNET = (*TRAINING[:-2], "train.stages.2.iterations=2", "train.critics.width=4")


def three_omissions(*found: Any) -> Any:
    """Return the first three steps that a study may leave out."""
    return islice(omissions(*found), 3)


def without_walk(problem: Any, mode: Any, seed: int, *_: Any, **how: Any) -> Any:
    """Draw from the posterior of a sensor by weights, which takes a hundredth of the time of a
    walk.
    """
    from tests.workflows.studies.test_calibration_study import resampled

    return resampled(problem, mode, seed)


#: of the fine grid of the pupil in front of which `neusee safety` puts a laser, and the fewest
#: draws that it takes
SAFETY = ("safety.draws=100", "optics.samples=128", "optics.window=[128, 128]")
#: spots behind an arm and behind a clear lens, irradiances of a curve, stops and exposures tried
FEW_SPOTS = {
    "safety.laser_spots:_MOST_SPOTS": 7,
    "safety.dazzled_area:_STEP": 1.5,
    "safety.dazzled_area:_WAVES": 2.0,
    "safety.safety_estimate:_SAMPLES": 60,
    "safety.what_helps:_HALF_STOP": 0.25,
    "safety.what_helps:_SHORTER": (1.0, 1e-2),
    "safety.what_helps:_LONGER": (1.0, 1e2),
}
#: behind the mask, with so few samples
DAZZLE = ("wide.window=[99, 99]", "safety.dazzle.share=0.001")
PROTECTION = (
    "optics.samples=128",
    "optics.pitch=63.11 um",
    "optics.bands=3",
    "optics.window=[64, 64]",
    "scene.shape=[64, 64]",
    "sensor.shape=[48, 48]",
    "--bands",
    "2",
)
TWO = (*PROTECTION, "--draws", "2")

CLUSTER = "tcp://scheduler:8786"
TWO_LASERS = ("~lasers.blue", "~lasers.cyan", "~lasers.yellow", "~lasers.red")
FEW_DRAWS = ("--draws", "100", "--walkers", "16")
#: steps; the command says that its chains are cut, by exit code 3
CUT = {"calibration.emcee_sampler:_FIRST_STEPS": 80, "calibration.emcee_sampler:_MOST_STEPS": 80}
LABORATORY = "calibrate my/lab --sensor lab"
DRAWN = {"calibration.emcee_sampler:sample": drawn_chains}
ONE_PLOT = {"calibration.emva_figures:PICTURES": {"photon_transfer": PICTURES["photon_transfer"]}}
#: two lasers of an evaluation's page, as weak as its points: each saturated pixel adds an unknown
#: to the filter
WEAK = {
    "evaluation.evaluation_result:_WEAKEST": 3.0,
    "evaluation.evaluation_result:CASES": {name: LASERS[name] for name in ("green", "red", NONE)},
}
PROTOCOL = (
    "scene.shape=[28,28]",
    "sensor.shape=[24,24]",
    "--scenes",
    "1",
    "--strengths",
    "0,3",
    "--pipelines",
    "flat+none, half_ring+none",
    "--equal-protection",
    "1e-5",
)
#: two of the six lasers of the protocol's page, and weak ones
TWO_OF_SIX = {
    "evaluation.evaluation_result:_WEAKEST": 3.0,
    "evaluation.evaluation_result:SIX": {name: LASERS[name] for name in ("green", "red", NONE)},
}
#: settings of an accuracy study, each measured once
FEW_POINTS = {
    "studies.accuracy_study:_QUICK_TOLERANCES": (1e-1,),
    "studies.accuracy_study:TIMES": 1,
    "studies.recipe_knobs:_QUICK_FACTORS": (1 / 3,),
    "studies.recipe_knobs:_QUICK_SCALES": (0.75,),
    "studies.work_precision:_CALLS": 1,
}
FEW_STOPS = {
    "protection.protection_result:_DIAMETER_RATIO": 0.5,
    "protection.protection_result:_MASK_STOPS": (1.0, 0.7),
}

#: of a recipe that states the sizes of its frame itself
SMALL_FRAME = ("scene.shape=[40, 40]", "sensor.shape=[32, 32]")

STAND_INS = {
    "run demonstration": StandIn("a frame of 256 x 256 pixels takes a minute", more=SMALL_FRAME),
    "run first_light doe=pixelwise doe.file=mask.npy": FULL_MASK,
    "run doe=pixelwise doe.file=mask.npy": FULL_MASK,
    "run paper_table1": StandIn(
        "the camera of the paper has 2160 x 2160 samples", more=("scene.shape=[36,36]", "sensor.shape=[32,32]")),
    'run first_light "scene.shape=[512,512]" "sensor.shape=[384,384]"': StandIn(
        "a field of 512 x 512", instead={"scene.shape=[512,512]": "scene.shape=[28,28]",
                                         "sensor.shape=[384,384]": "sensor.shape=[24,24]"}
    ),
    'run train optics=small sensor=small "scene.shape=[768,768]"': StandIn(
        "a field of 768 x 768", instead={"scene.shape=[768,768]": "scene.shape=[36,36]"}
    ),
    "restore runs/latest/data/raw_mask.png --camera plain_lens --psf points points.window=[33,33]": StandIn(
        "a frame of 24 x 24", instead={"points.window=[33,33]": "points.window=[5,5]"}),
    "restore runs/latest/data/raw_mask.png --camera plain_lens --psf points points.window=[33,33] "
    "restore=search": StandIn(
        "a frame of 24 x 24", instead={"points.window=[33,33]": "points.window=[5,5]"},
        more=("restore.most=1", "restore.lamps=0")),
    "run six_lasers": StandIn("two of the six lasers", more=TWO_LASERS),
    "run six_lasers --executor slurm:8": StandIn(
        "two lasers, other noise, and a scheduler on this machine in the place of jobs",
        more=(*TWO_LASERS, "seed=10"), instead={"slurm:8": "LOCAL"}),
    "run six_lasers --executor dask:2": StandIn(
        "two lasers, other noise, and one process", more=(*TWO_LASERS, "seed=8"), instead={"dask:2": "dask:1"}),
    f"run six_lasers --executor {CLUSTER}": StandIn(
        "a scheduler and a worker on this machine", more=(*TWO_LASERS, "seed=9"), instead={CLUSTER: "LOCAL"}
    ),
    "train train_small": StandIn("a training of an hour", more=(*TRAINING, *ONE)),
    "train train_small train=as_printed": StandIn("a training of an hour", more=(*TRAINING, *ONE)),
    f"{SIX}": StandIn("a training of 20 s", more=TRAINING, instead=SHORT),
    f"{SIX} --out runs/two": StandIn("a training of 20 s", more=TRAINING, instead=SHORT, processes=2),
    "train train --device cuda": StandIn("days on a GPU", more=PAPER_TRAINING, instead={"cuda": "cpu"}),
    "train train train.photographs=my_photographs --device cuda": StandIn(
        "days on eight GPUs: two processes, and gloo", more=PAPER_TRAINING, instead={"cuda": "cpu"}, processes=2),
    f'train train_small doe=shaded "{LIMITED}" --stage mask': StandIn(
        "an hour", more=TRAINING, instead={LIMITED: LIMITED.replace("{kind", "{iterations: 2, kind")}),
    "train train_small train.photographs=my_photographs": StandIn("ten minutes", more=(*TRAINING, *ONE)),
    "train train_small train.photographs=my_photographs train.validate_every=100 train.patience=5": StandIn(
        "ten minutes", more=(*TRAINING, *ONE)),
    "train train_small train.photographs=my_photographs train.augment.symmetries=all "
    "train.augment.exposure=2 "
    "train.augment.colour=0.3": StandIn("ten minutes", more=(*TRAINING, *ONE)),
    "train train_small train.photographs=my_photographs train.picture=restored +mismatch=usual": StandIn(
        "ten minutes", more=(*TRAINING, *ONE)),
    "train train_small train.photographs=my_photographs train.picture=restored "
    "+height_error=smooth "
    "\"train.mismatch={height_error.rms: 'uniform(0 nm, 20 nm)', height_error.depth: 'normal(0, 0.01)'}\"": StandIn(
        "ten minutes", more=(*TRAINING, *ONE)),
    "train train_small train.photographs=my_photographs train.stages.1.iterations=3000 "
    "train.stages.2.iterations=8000": StandIn("a night", more=TRAINING, instead=NIGHT),
    'train my/train_smallnet.yaml "train.export=[pt2]"': StandIn("minutes", more=SMALLNET),
    "train train_informed train.photographs=my_photographs +mismatch=usual": StandIn("half an hour", more=(
        *TRAINING[:-2], "train.network.width=2", "train.pool=2", "train.cameras=[[doe=flat]]",
        "train.stages.2.iterations=1", "train.stages.2.batch=2")),
    "train train_unrolled train.photographs=my_photographs": StandIn("half an hour", more=(
        *TRAINING[:-2], "train.network.width=2", "train.pool=2", "train.stages.2.iterations=1",
        "train.stages.2.batch=2",
    )),
    "evaluate train_informed --data photographs --scenes 8 --strengths 0,1e3,1e5 "
    '--pipelines "half_ring+wiener_uncertain, half_ring+informed@best.safetensors"': StandIn(
        "8 scenes", instead={"8": "1", "0,1e3,1e5": "3"}, more=("+evaluate={mismatch: null}",), constants=WEAK),
    "train my/train_smallnet.yaml train.start=smallnet.safetensors train.rates.weights=5e-5": StandIn(
        "minutes", more=SMALLNET),
    "train train_demonstration --stage mask": StandIn("half an hour", more=DEMONSTRATION),
    "train train_demonstration --stage 2": StandIn("half an hour", more=DEMONSTRATION),
    "train my/train_smallnet.yaml": StandIn("minutes", more=SMALLNET),
    "train my/train_smallnet.yaml train.stages.2.iterations=40": StandIn("half a minute", more=SMALLNET),
    "train train_lift": StandIn("hours", more=(
        "patch.shape=[8, 8]", "patch.leaves=8", "train_lift.iterations=4", "train_lift.batch=1", "train_lift.keep=2",
        "train_lift.warmup=2", "train_lift.validation_batches=2")),
    "study accuracy first_light --quick": StandIn("minutes", more=(
        "laser=none", "outputs=[raw,lsr]", "--seeds", "1"), constants=FEW_POINTS),
    "study stability first_light": StandIn("minutes: the first two of the extreme cases", constants={
        "studies.stability_study:StabilityOptions": partial(stability_study.StabilityOptions, cases=CASES[:2])}),
    "study uncertainty my/uncertain.yaml --error 0.1 --points sobol": StandIn(
        "a thousand draws", instead={"0.1": "0.9"}, more=("--most", "64", "outputs=[restored_quality]")),
    'study uncertainty first_light sensor.read_noise="normal(10.5 e-, 0.5 e-)"': StandIn(
        "minutes: hundreds of draws; the few small pixels that saturate are always the same", more=(
            "--error", "0.5", "--most", "64", "outputs=[restored_quality]")),
    "study leave-out first_light": StandIn(
        "minutes: three omissions, and what simpler scenes cost is not measured", more=("outputs=[raw,lsr]",),
        constants={"studies.leave_out_study:measure_scenes": lambda *_: [],
            "studies.left_out_steps:omissions": three_omissions}),
    "study calibration calibrate --simulations 100": StandIn(
        "minutes: 20 sensors of 32 x 32 pixels, and draws without a walk", more=("flats.shape=[32,32]",
            "sensor.gain=0.37 DN/e-"), instead={"100": "20"},
        constants={"studies.calibration_study:PIXELS": 32,
                   "studies.calibration_study:walk_draws": without_walk}),
    **{f"sheet {words}": StandIn("seconds for each plot", constants=ONE_PLOT) for words in (
        'my/set/EMVA1288_descriptor.txt --state "wavelength=525 nm" --state "temperature=25 °C"',
        "my/frames.yaml --relative")},
    LABORATORY: StandIn("a minute: draws without a walk", constants=DRAWN),
    "calibrate calibrate": StandIn("minutes", more=("flats.shape=[32,32]", *FEW_DRAWS), constants=CUT, code=3),
    "calibrate calibrate_camera table.file=my.csv": StandIn("minutes", more=FEW_DRAWS, constants=CUT, code=3),
    "calibrate calibrate_camera": StandIn("minutes", more=FEW_DRAWS, constants=CUT, code=3),
    "calibrate calibrate_stray_light": StandIn("minutes", more=FEW_DRAWS, constants=CUT, code=3),
    **{f"safety {words}": StandIn("a fine grid of the spot, and a thousand draws", more=SAFETY, constants=FEW_SPOTS) for words in (
        "safety_car_lidar_1550", "safety_car_lidar_1550 --json")},
    **{f"safety {words}": StandIn("fine grids, and a thousand draws", more=(*SAFETY, *DAZZLE), constants=FEW_SPOTS) for words in (
        "safety_pointer", "safety_car_lidar", "safety_drone_dazzler", "safety_laboratory", "safety_show",
        "my/pointer.yaml", 'safety_show safety.protection.filter=1e-3 "lasers.show.distance=20 m"',
        'safety_show safety.eye.dazzle.contrast=0.5 "safety.eye.dazzle.backgrounds=[1 cd/m2]"',
        "safety_car_lidar safety.damage.file=my/sensor/shots.csv")},
    "safety safety_pointer safety.protection.mask=null +safety.lens.focus=laser "
    "+safety.lens.scatter.share=0.002": StandIn("a thousand draws", more=SAFETY[:1], constants=FEW_SPOTS),
    "safety first_light laser=pointer +safety=camera": StandIn("a thousand draws", more=SAFETY[:1], constants=FEW_SPOTS),
    'safety first_light laser=pointer +safety=camera doe=vortex "lasers.pointer.power=uniform(1 mW, 5 mW)"': StandIn(
        "a thousand draws", more=SAFETY[:1], constants=FEW_SPOTS),
    "study protection five_half_rings": StandIn("ten minutes: two draws", more=TWO, constants=FEW_STOPS),
    "study protection five_half_rings sensor=night": StandIn("ten minutes: two draws", more=TWO, constants=FEW_STOPS),
    "study protection five_half_rings --draws 6": StandIn(
        "minutes", more=PROTECTION, instead={"6": "2"}, constants=FEW_STOPS),
    "study protection five_half_rings --draws 3 --bands 2": StandIn(
        "minutes", more=PROTECTION, instead={"3": "2"}, constants=FEW_STOPS),
    "study protection axicon doe.waves=5 --light continuous --draws 6": StandIn(
        "minutes", more=PROTECTION, instead={"6": "2"}, constants=FEW_STOPS),
    "evaluate paper_protocol --data photographs": StandIn(
        "days: the camera of the paper has 2160 x 2160 samples", more=PROTOCOL, constants=TWO_OF_SIX),
    f"{EVALUATE} --scenes 3 --strengths 0,1e3,1e6": StandIn(
        "a minute", instead={**FIELD, "3": "1", "0,1e3,1e6": "0,3"}, constants=WEAK),
    f"{EVALUATE} --scenes 3 --strengths 1e4,1e6 "
    '--pipelines "flat+wiener, half_ring+wiener, five_half_rings+wiener" --equal-protection 0.002': StandIn(
        "minutes", more=("--by", "filter"), constants=WEAK,
        instead={**FIELD, "3": "1", "1e4,1e6": "10", "0.002": "1e-5",
                 "flat+wiener, half_ring+wiener, five_half_rings+wiener": "flat+none, five_half_rings+none"}),
    f"{EVALUATE} --scenes 3 --strengths 1e2,1e4,1e6 "
    '--pipelines "flat+none, half_ring+none, five_half_rings+none"': StandIn(
        "a minute", instead={**FIELD, "3": "1", "1e2,1e4,1e6": "1,10"}, constants=WEAK),
    f'{EVALUATE} --data photographs --pipelines "flat+none, half_ring+wiener, pixelwise@mask.npy+wiener"': StandIn(
        "20 scenes, a mask of 540 samples", instead={**FIELD, PIPELINES: PIPELINES.replace("mask", "mask_128")},
        more=("--scenes", "1", "--strengths", "3", "+evaluate={mismatch: null}"), constants=WEAK),
    f'{EVALUATE} --pipelines "flat+none, five_half_rings+nafnet@net.safetensors" --reference flat+none': StandIn(
        "20 scenes", instead=FIELD, more=("--scenes", "1", "--strengths", "3"), constants=WEAK),
    "evaluate my/train_smallnet.yaml --scenes 3 --strengths 0,1e3 --pipelines "
    "flat+none,five_half_rings+smallnet@smallnet.safetensors": StandIn(
        "three scenes", instead={"3": "1", "0,1e3": "3"}, constants=WEAK),
}  # fmt: skip


def stand_in(words: str, folder: Path) -> StandIn | None:
    """Return the stand-in of a command, or None if it runs as it stands; raise `NotDeclared` if
    it is too large.
    """
    kind, declared = words.split()[0], STAND_INS.get(words)
    if kind in LIGHT:
        return declared
    if declared is None and kind not in SIZED and not words.startswith("study uncertainty"):
        raise NotDeclared(f"neusee {words}: say in STAND_INS how a test runs this command")
    text = _recipe_text(words, folder)
    # no expected numbers
    if (declared is None and not OF_PACKAGE.search(text)) or kind in ("sheet", "calibrate"):
        return declared
    found = declared or StandIn(
        "the camera is small; expected numbers are those of the full camera"
    )
    numbers = re.search(r"^expect:", text, re.MULTILINE) and OF_PACKAGE.search(text)
    return found._replace(more=(*found.more, *(["~expect"] if numbers else [])))


def _recipe_text(words: str, folder: Path) -> str:
    """Return the text of the recipe that a command names, that of first light if it names none."""
    named = [word for word in shlex.split(words)[1:] if not re.search(r"[=~]|^-", word)]
    name = next(
        (
            word
            for word in named
            if word.endswith(".yaml") or (ROOT / f"recipes/{word}.yaml").is_file()
        ),
        None,
    )
    own = name is not None and name.endswith(".yaml")
    return (
        folder / str(name) if own else ROOT / f"recipes/{name or 'first_light'}.yaml"
    ).read_text(encoding="utf-8")


def typed(words: str, found: StandIn | None) -> list[str]:
    """Return the words of a command as a test types them."""
    found = found or StandIn("")
    own = shlex.split(words)
    missing = [word for word in found.instead if word not in own]
    assert not missing, f"{words}: no word {missing} to replace"
    return [*(found.instead.get(word, word) for word in own), *found.more]
