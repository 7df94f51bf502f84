"""Is a network of `train_informed` better than the filter it begins with, on photographs that it
never saw?

    python tests/benchmarks/bench_informed.py frames/ --pictures photographs/ --count 37
    python tests/benchmarks/bench_informed.py frames/ --report --weights best.safetensors

The camera is that of `train_informed`, 128 x 128 pixels. For each photograph the true lens and
laser differ from the recipe by the laws of `mismatch: usual`, and exposure, read noise and laser
are drawn by those of the training. One simulated frame is restored by the filter that believes the
recipe (`wiener`, doubt 0), with the likeliest doubt (null), by the filter with drawn patterns
(`wiener_uncertain`), and by the network. Each photograph has a frame behind each mask, with
strengths in turn; a third of them have a strong laser also behind a grey filter and behind a
smaller stop that protect the sensor as much as the designed mask, and frames of a second camera
(other lens, pixels, well and colours) and of a larger sensor, which no training knows. Intervals
are bootstrap-t over photographs. The folder keeps the frames, so that a run that was stopped goes
on, and other weights are judged in a minute.
"""

import argparse
import functools
import json
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from neusee.nodes import metrics, restore
from neusee.nodes.restore import Informed
from neusee.nodes.scene import Photographs
from neusee.nodes.values import FilterFacts
from neusee.workflows import Store, load
from neusee.workflows.evaluation.confidence_intervals import less
from neusee.workflows.training.training_pictures import HELD_OUT, PictureSource, TrainingStream

ROOT = Path(__file__).parents[2]
DESIGNED = ROOT / "recipes" / "samples" / "demonstration_mask.png"
#: brightest pixel behind the designed mask at the worst wavelength, over that behind the plain lens
PEAK = 0.0121764
IN_TURN = (0.0, 1e4, 1e1, 1e5, 1e2, 1e6, 0.0, 1e3)  #: strengths of the frames
WEAK, STRONG = (0.0, 1e1, 1e2), (1e3, 1e4, 1e5, 1e6)
MASKS = ("plain", "half_ring", "designed")
RIVALS = ("grey", "stop")  #: of the designed mask: the plain lens with as low a peak
SECOND = (  #: lens, sensor and colours of a camera that no training knows
    "optics.focal_length=0.08 m",
    "sensor.pixel_pitch=3 um",
    "sensor.camera=Nikon 5100",
    "sensor.full_well=15000 e-",
    "sensor.gain=0.25 e-/DN",
    "sensor.read_noise=uniform(4 e-, 6 e-)",
    "sensor.quantum_efficiency=0.65",
)
#: so that the PSF of a larger frame repeats outside
FINER = ("optics.samples=384", "optics.pitch=21.037 um")
OTHERS = {  #: cameras beside that of the training, by name: the mask, and what differs
    "second plain": ("plain", SECOND),
    "second half_ring": ("half_ring", SECOND),
    "larger half_ring": (
        "half_ring",
        ("scene.shape=[352, 352]", "sensor.shape=[288, 288]", *FINER),
    ),
}
#: diameter whose brightest pixel is PEAK at 400 nm, its worst; without an average it were
#: PEAK**0.25
STOP = 0.3237
BACKGROUND, DIAMETER = 0.7, 8.0784
EACH = 3  #: photographs, of which one is seen by the rivals and by the other cameras too
NO_POOL = ("+mismatch=usual", "train.augment.pooled=none", "train.pool=null")
METHODS = ("developed", "told", "likeliest", "uncertain", "network")
STEPS = """
steps:
  facts:
    node: restore.filter_facts
    from:
      electrons: signal[mask]
      psf: psf[mask]
      illuminant: illuminant
      responses: responses
      bands: bands
      clipped: clipped[mask]
      glare: laser_photons[mask]
      nearby: nearby[mask]
      ghosts: ghost_photons[mask]
    with: {doubt: null, read_noise: "${sensor.read_noise}"}
  told_deconvolved:
    node: restore.wiener
    from: &told
      electrons: signal[mask]
      psf: psf[mask]
      illuminant: illuminant
      responses: responses
      bands: bands
      clipped: clipped[mask]
      glare: laser_photons[mask]
      ghosts: ghost_photons[mask]
    with: {doubt: 0, read_noise: "${sensor.read_noise}"}
  told: {node: restore.colour, from: {channels: told_deconvolved, matrix: matrix}}
  likeliest_deconvolved: {node: restore.wiener, from: *told, with: {doubt: null, read_noise: "${sensor.read_noise}"}}
  likeliest: {node: restore.colour, from: {channels: likeliest_deconvolved, matrix: matrix}}
"""


class Judged(TrainingStream):
    """Frames of photographs with the pictures of the filters, and with a laser of one strength
    times a factor.
    """

    strength = factor = 1.0
    filters: tuple[str, ...] = ("told", "likeliest")

    def _outputs(self, number):
        return ("facts", "matrix", "developed[mask]", *self.filters, self.settings.truth)

    def _drawn(self, stage, number):
        theta, noise, drawn = super()._drawn(stage, number)
        return theta | dict.fromkeys(self._lasers, self.strength * self.factor), noise, drawn

    def _sample(self, values, drawn):
        facts, matrix, truth = (
            values["facts"],
            values["matrix"].float(),
            values[self.settings.truth].float(),
        )
        picture = restore.colour(facts.answer * facts.scale + facts.mean, matrix).float()
        shown = {
            "developed": values["developed[mask]"],
            "uncertain": picture,
            **{n: values[n] for n in self.filters},
        }
        kept = {"matrix": matrix, "truth": truth, "picture": picture, **facts._asdict()}
        half = {
            name: x.to(torch.float16 if name == "maps" else torch.float32).contiguous()
            for name, x in kept.items()
        }
        return {name: scored(x, truth) for name, x in shown.items()}, half


def scored(picture, truth):
    quality = metrics.quality(picture.float(), truth.float())
    return {"psnr": round(float(quality.psnr), 3), "ssim": round(float(quality.ssim), 4)}


class OfRival(Judged):
    filters = ()


def words(mask):
    """What turns the recipe into that of a mask, or of a rival of the designed mask."""
    mask, more = OTHERS.get(mask, (mask, ()))
    doe = {
        "half_ring": ["doe=half_ring"],
        "designed": ["doe=pixelwise", f"doe.file={DESIGNED}", "doe.between=nearest"],
    }.get(mask, ["doe=flat"])
    light = {"grey": PEAK, "stop": STOP**2}.get(mask, 1.0)
    size = DIAMETER * (STOP if mask == "stop" else 1.0)
    light = [f"sensor.background={BACKGROUND * light}", f"optics.diameter={size} mm"]
    return [
        *doe,
        *light,
        *more,
        "train.cameras=[]",
        "train.network={kind: nafnet, width: 16}",
        *NO_POOL,
    ]


def strengths_of(number, masks):
    """The strengths of the frames of a photograph, by those of the named masks, rivals and
    cameras that it has.
    """
    strengths = {mask: IN_TURN[(3 * number + m) % len(IN_TURN)] for m, mask in enumerate(MASKS)}
    if number % EACH == 0:
        strengths |= dict.fromkeys(RIVALS, STRONG[number // EACH % len(STRONG)])
        strengths |= {
            name: IN_TURN[(number // EACH + m) % len(IN_TURN)] for m, name in enumerate(OTHERS)
        }
    return {mask: strength for mask, strength in strengths.items() if mask in masks}


def run(folder, pictures, count, masks):
    """Simulate and filter the frames behind the named masks, rivals and cameras that the folder
    lacks.
    """
    photographs = Photographs.under(pictures)
    held_out = photographs.paths[:count]
    folder.mkdir(exist_ok=True)
    done = {(r["photograph"], r["mask"], r["strength"]) for r in rows(folder)}
    recipe_file, store, streams = folder / "judged.yaml", Store(folder / "cache"), {}
    recipe_file.write_text((ROOT / "recipes" / "train_informed.yaml").read_text() + STEPS)
    for number, photograph in enumerate(held_out):
        for mask, strength in strengths_of(number, masks).items():
            if (photograph.name, mask, strength) in done:
                continue
            if mask not in streams:
                recipe = load(recipe_file, words(mask))
                kind = OfRival if mask in RIVALS else Judged
                source = PictureSource(photographs, store, held_out=held_out)
                streams[mask] = kind(recipe, recipe.training, source, frozen=recipe)
            streams[mask].strength, streams[mask].factor = strength, PEAK if mask in RIVALS else 1.0
            found, kept = streams[mask]({}, HELD_OUT, number)
            name = f"{number:03d}_{mask.replace(' ', '_')}_{strength:g}"
            save_file(kept, folder / f"{name}.safetensors")
            each = {
                "photograph": photograph.name,
                "mask": mask,
                "strength": strength,
                "file": name,
                **found,
            }
            with (folder / "frames.jsonl").open("a") as out:
                out.write(json.dumps(each) + "\n")


def rows(folder):
    path = folder / "frames.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def judged(folder, weights, width):
    """Return the frames of the folder with the score of the network."""
    found = rows(folder)
    for row in found:
        row["network"] = judged_frame(
            weights, width, load_file(folder / f"{row['file']}.safetensors")
        )
    return found


def judged_frame(weights, width, kept):
    """Return the score of a network on a frame that `Judged` kept."""
    net = network(weights, width)
    facts = FilterFacts._make(kept[name].float() for name in FilterFacts._fields)
    with torch.no_grad():
        return scored(net(kept["picture"][None], facts, kept["matrix"])[0], kept["truth"])


@functools.cache
def network(weights, width):
    net = Informed(width).eval()
    net.load_state_dict({name: x.float() for name, x in load_file(weights).items()})
    return net


# --- the tables -----------------------------------------------------------------------------------


def gain(found, other, what="psnr"):
    """Mean gain of the network over another restorer, and its 95 % interval over photographs."""
    names = sorted({row["photograph"] for row in found})
    photographs = np.array([names.index(row["photograph"]) for row in found])
    values, own = (np.array([row[m][what] for row in found]) for m in (other, "network"))
    x = less(values, own, photographs, 0)
    return f"{x.mean:+.2f} ({x.low:+.2f} to {x.high:+.2f})"


def report(found):
    """Print the tables in Markdown."""
    print(f"| mask | strength | frames | {' | '.join(METHODS)} | over likeliest | over uncertain |")
    print("|---" * (len(METHODS) + 5) + "|")
    groups = [
        *((f"{s:g}", (s,)) for s in (*WEAK, *STRONG)),
        ("0 to 100", WEAK),
        ("1e3 to 1e6", STRONG),
    ]
    for mask in (*MASKS, *RIVALS, *OTHERS):
        for name, strengths in [*groups, ("all", (*WEAK, *STRONG))]:
            some = [r for r in found if r["mask"] == mask and r["strength"] in strengths]
            if some:
                has = [m for m in METHODS if m in some[0]]
                means = " | ".join(
                    f"{np.mean([r[m]['psnr'] for r in some]):.2f}" if m in has else ""
                    for m in METHODS
                )
                gains = " | ".join(
                    gain(some, m) if m in has else "" for m in ("likeliest", "uncertain")
                )
                print(f"| {mask} | {name} | {len(some)} | {means} | {gains} |")
    some = [r for r in found if r["mask"] in MASKS]
    print(f"\nAll {len(some)} behind lens and masks, the network over another restorer:")
    for m in METHODS[:-1]:
        each = sorted(r["network"]["psnr"] - r[m]["psnr"] for r in some)
        worse = (
            f"{np.mean(np.array(each) < 0):.0%} worse, the worst five by"
            f" {[round(x, 2) for x in each[:5]]} dB"
        )
        print(f"- {m}: {gain(some, m)} dB, SSIM {gain(some, m, 'ssim')}, {worse}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder of photographs that no training saw")
    parser.add_argument("--count", type=int, default=37)
    every = (*MASKS, *RIVALS, *OTHERS)
    parser.add_argument(
        "--masks", nargs="+", default=every, choices=every, help="masks, rivals and cameras"
    )
    parser.add_argument(
        "--weights", type=Path, help="of the network: best.safetensors of a training"
    )
    parser.add_argument("--width", type=int, default=12)
    parser.add_argument("--report", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.pictures:
        run(given.folder, given.pictures, given.count, given.masks)
    if given.report:
        report(judged(given.folder, given.weights, given.width))
