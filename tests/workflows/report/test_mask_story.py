"""What a mask buys and costs: two sentences that follow from the numbers of the run, or none."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from neusee.nodes.values import Bands
from neusee.workflows.engine.wanted_steps import wanted
from neusee.workflows.recipe.loading import load
from neusee.workflows.report import console, run_folder, run_summary
from neusee.workflows.report.run_summary import sentences

PLAIN = {"peak/I_sat": 912.3, "LSR": 1.0, "PSNR (dB)": 27.07, "saturated px": 244.0}
MASK = {"peak/I_sat": 3.867, "LSR": 0.00149, "PSNR (dB)": 14.59, "saturated px": 418.0}
GREEN = {"530 nm": 0.00149}


def said(plain=PLAIN, mask=MASK, restored=None, lsr=GREEN, laser=True):
    numbers = {
        "plain lens": plain,
        "with mask": mask,
        "restored": {} if restored is None else {"PSNR (dB)": restored},
    }
    return sentences(numbers, lsr, laser)


def test_both_sentences_have_the_numbers_of_the_run():
    assert said(restored=17.67) == {
        "buys": (
            "The mask lowers the peak on the sensor: the brightest pixel receives 236 times less"
            " light than behind the plain lens (3.87 in place of 912 times saturation; LSR 0.00149"
            " at 530 nm)."
        ),
        "costs": (
            "The mask costs picture quality: PSNR 27.1 dB with the plain lens, 14.6 dB with the"
            " mask, and 17.7 dB after restoration; 418 pixels saturate with the mask, 244 without:"
            " the mask enlarges the dazzled area 1.71 times."
        ),
    }


def test_a_mask_that_gains_nothing_is_not_praised():
    worse = said(plain=MASK, mask=PLAIN, lsr={"530 nm": 1.0})["buys"]
    assert worse.startswith(
        "The mask raises the peak on the sensor: the brightest pixel receives 236 times more light"
        " than"
    )
    same = said(mask=PLAIN, lsr={"530 nm": 1.0})["buys"]
    assert same.startswith(
        "The mask does not change the peak on the sensor: the brightest pixel receives as much"
        " light as behind"
    )
    assert same.endswith("LSR 1 at 530 nm).")


@pytest.mark.parametrize(
    ("mask", "restored", "opening"),
    [
        (
            14.59,
            None,
            (
                "The mask costs picture quality: PSNR 27.1 dB with the plain lens and 14.6 dB with"
                " the mask;"
            ),
        ),
        (
            14.59,
            27.08,
            (
                "The mask costs picture quality, which restoration wins back: PSNR 27.1 dB with the"
                " plain lens, 14.6"
            ),
        ),
        (
            27.08,
            12.0,
            (
                "The mask costs no picture quality here: PSNR 27.1 dB with the plain lens, 27.1 dB"
                " with the mask, and"
            ),
        ),
        (
            math.inf,
            None,
            (
                "The mask costs no picture quality here: PSNR 27.1 dB with the plain lens and inf"
                " dB with the"
            ),
        ),
    ],
)
def test_the_cost_follows_from_the_quality(mask, restored, opening):
    assert said(mask=MASK | {"PSNR (dB)": mask}, restored=restored)["costs"].startswith(opening)


@pytest.mark.parametrize(
    ("without", "behind", "end"),
    [
        (244, 244, "; 244 pixels saturate with and without the mask."),
        (0, 0, "; no pixel saturates."),
        (173788, 0, "; 0 pixels saturate with the mask, 173,788 without."),
        (0, 12, "; 12 pixels saturate with the mask, 0 without."),
        (
            23643,
            173788,
            (
                "; 173,788 pixels saturate with the mask, 23,643 without: the mask enlarges the"
                " dazzled area 7.35 times."
            ),
        ),
    ],
)
def test_the_saturated_pixels_are_compared(without, behind, end):
    found = said(plain=PLAIN | {"saturated px": without}, mask=MASK | {"saturated px": behind})
    assert found["costs"].endswith(end)


def test_without_a_laser_no_area_is_dazzled():
    found = said(lsr={}, laser=False)["costs"]
    assert found.endswith("; 418 pixels saturate with the mask, 244 without.")


def test_without_a_laser_the_mask_is_not_said_to_protect():
    found = said(lsr={}, laser=False)["buys"]
    assert found.startswith(
        "No laser shines here, whose peak the mask could lower: the brightest pixel"
    )
    assert "LSR" not in found
    assert "buys" not in found


@pytest.mark.parametrize(
    ("peak", "words"),
    [
        (
            3.46,
            (
                "receives as much light as behind the plain lens (3.46 in place of 3.46 times"
                " saturation)"
            ),
        ),
        (
            3.24,
            (
                "receives 6 % less light than behind the plain lens (3.24 in place of 3.46 times"
                " saturation)"
            ),
        ),
        (
            5.19,
            (
                "receives 50 % more light than behind the plain lens (5.19 in place of 3.46 times"
                " saturation)"
            ),
        ),
        (6.92, "receives 2 times more light than"),
    ],
)
def test_a_small_change_is_told_in_percent(peak, words):
    assert words in said({"peak/I_sat": 3.46}, {"peak/I_sat": peak}, lsr={}, laser=False)["buys"]


def test_a_mask_that_protects_little_is_not_praised():
    found = said({"peak/I_sat": 912.0}, {"peak/I_sat": 608.0})["buys"]
    assert found.startswith(
        "The mask lowers the peak on the sensor a little: the brightest pixel receives 33 % less"
        " light"
    )


@pytest.mark.parametrize("judged", [False, True])
def test_the_peak_is_said_in_watts_and_no_multiple_is_a_verdict_of_damage(judged):
    """First light: 912 I_sat are 1.8 mW/cm2, ten million times below what damages; a mask
    protects from nothing.
    """
    found = run_summary.irradiance({"plain lens": 18.4, "with mask": 0.0782}, judged)["irradiance"]
    assert found.startswith(
        "The lasers have 1.84 mW/cm2 behind the plain lens and 7.82 uW/cm2 behind the mask there: "
    )
    assert ("`damage: published`" in found) is not judged
    assert found.endswith("and a multiple of saturation is not a measure of damage.")
    assert run_summary.irradiance({"plain lens": 0.0}, judged) == {}
    for watts, text in (
        (1e4, "1 W/cm2"),
        (7.35e5, "73.5 W/cm2"),
        (7.8e9, "780 kW/cm2"),
        (3e13, "3 GW/cm2"),
    ):
        assert text in run_summary.irradiance({"plain lens": watts}, judged)["irradiance"]


def test_several_lasers_have_the_least_and_the_largest_ratio():
    found = said(lsr={"410 nm": 0.0012, "530 nm": 0.00149, "690 nm": 0.0022})["buys"]
    assert found.endswith("; LSR from 0.0012 at 410 nm to 0.0022 at 690 nm).")


def test_large_numbers_have_no_exponent():
    assert (
        "receives 235,195 times less light" in said(plain=PLAIN | {"peak/I_sat": 9.095e5})["buys"]
    )
    assert (
        "in place of 909,500 times saturation"
        in said(plain=PLAIN | {"peak/I_sat": 9.095e5})["buys"]
    )


def test_a_sentence_without_its_numbers_is_left_out():
    assert sentences({"plain lens": PLAIN, "with mask": {}, "restored": {}}, GREEN, True) == {}
    assert sentences({"with mask": MASK}, GREEN, True) == {}
    peaks = [{"peak/I_sat": arm["peak/I_sat"]} for arm in (PLAIN, MASK)]
    assert list(said(*peaks)) == ["buys"]
    pictures = [{"PSNR (dB)": arm["PSNR (dB)"]} for arm in (PLAIN, MASK)]
    assert list(said(*pictures, lsr={})) == ["costs"]
    assert (
        said(*pictures)["buys"]
        == "The mask buys a weaker laser: LSR 0.00149 at 530 nm of the peak behind the clear lens."
    )


def run_of(lasers, values):
    """A recipe with a line for each laser, and the values of the steps."""
    lines = {
        f"line[{name}]": Bands(*(torch.tensor([x]) for x in (nm * 1e-9, 1e-9, 1.0)))
        for name, nm in lasers.items()
    }
    centres = torch.tensor([410e-9, 530e-9, 690e-9], dtype=torch.float64)
    values = values | lines | {"bands": Bands(centres, centres, centres)}
    strengths = {f"lasers.{name}.strength": 0.0 if name == "dark" else 1e3 for name in lasers}
    recipe = SimpleNamespace(steps=dict.fromkeys(values), config=SimpleNamespace(values=strengths))
    return run_summary.story(recipe, dict.fromkeys(values, ""), values.__getitem__)


PAIR = {
    "peak[plain]": torch.tensor(912.3),
    "peak[mask]": torch.tensor(3.867),
    "lsr[mask]": torch.tensor([0.0011, 0.0015, 0.0022]),
}


@pytest.mark.parametrize(
    ("lasers", "lsr", "words"),
    [
        ({"green": 532}, {"530 nm": 0.0015}, "LSR 0.0015 at 530 nm"),
        (
            {"violet": 405, "red": 700},
            {"410 nm": 0.0011, "690 nm": 0.0022},
            "LSR from 0.0011 at 410 nm to 0.0022 at 690 nm",
        ),
        ({"dark": 532}, {}, "No laser shines here"),
        ({"dark": 532, "red": 700}, {"690 nm": 0.0022}, "LSR 0.0022 at 690 nm"),
        ({}, {}, "No laser shines here"),
    ],
)
def test_the_lasers_that_shine_give_the_ratios(lasers, lsr, words):
    found = run_of(lasers, PAIR)
    assert found["lsr"] == pytest.approx(lsr)
    assert words in found["buys"]
    assert "costs" not in found
    assert found["numbers"]["plain lens"] == pytest.approx({"peak/I_sat": 912.3})


def test_a_run_of_one_arm_or_without_numbers_tells_nothing():
    for names in (["peak[plain]"], ["peak[mask]", "lsr[mask]"], []):
        assert run_of({"green": 532}, {name: PAIR[name] for name in names}) == {
            "numbers": {},
            "lsr": {},
        }
    missing = {"peak[plain]": torch.tensor(math.nan), "peak[mask]": torch.tensor(2.0)}
    assert run_of({"green": 532}, missing) == {"numbers": {}, "lsr": {}}


EMPTY = [
    "notes",
    "warnings",
    "missed",
    "failed",
    "expected",
    "unchecked",
    "left_out",
    "figures",
    "readings",
    "absent",
    "steps",
    "missing",
    "facts",
    "inputs",
]


@pytest.fixture
def document():
    told = dict.fromkeys(
        ("recipe", "title", "started", "device", "counts", "command", "version"), ""
    )
    numbers = {"verdict": "Right.", "seconds": 1.0, "tolerance": 1e-3}
    spent = {"economies": [], "left_out": [], "exact": True}
    table = {"columns": [], "rows": [], "legend": []}
    rest = {"spent": spent, "table": table, "story": said(restored=17.67)}
    return {**{name: [] for name in EMPTY}, **told, **numbers, **rest}


def test_the_terminal_ends_with_the_story_no_wider_than_it_is(document, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    document["figures"] = [{"name": "overview"}]
    lines = console.closing(document, "runs/one/report.html", [])
    assert max(map(len, lines)) <= 80
    told = " ".join(line.strip() for line in lines[1 : lines.index("", 1)])
    assert told == " ".join(document["story"][name] for name in ("buys", "costs"))
    assert lines[-4:-2] == [
        "pictures runs/one/figures/overview.png",
        "report   runs/one/report.html",
    ]
    document |= {"story": {}, "figures": []}
    assert console.closing(document, "runs/one/report.html", [])[:2] == ["", "Right.  (, 1.00 s)"]


def test_the_page_leads_with_the_pictures_and_the_story(document):
    document["figures"] = [
        {"name": "overview", "title": "What the camera sees", "caption": "Pictures."}
    ]
    page = run_folder.page(document, {"overview": b"png"})
    places = [
        page.index(text)
        for text in (*document["story"].values(), 'alt="What the camera', "Right.", 'id="notes"')
    ]
    assert places == sorted(places)
    wrong = run_folder.page(document | {"failed": ["a check"]}, {"overview": b"png"})
    assert wrong.index("Right.") < wrong.index(document["story"]["buys"])
    assert "What the camera sees" not in run_folder.page(document | {"story": {}}, {})


@pytest.mark.parametrize(
    "why", ["`neusee study accuracy first_light` measures it", "the recipe has no step dirt"]
)
def test_the_page_shows_no_backtick(document, why):
    """Words between backticks are code, in the story and in the reasons of what is not drawn."""
    document["story"] |= run_summary.irradiance(
        {"plain lens": 18.4, "with mask": 0.0782}, judged=False
    )
    document["missing"] = [{"title": "Error against run time", "why": why}]
    page = run_folder.page(document, {})
    assert "<code>damage: published</code> and <code>neusee safety</code> compare them" in page
    assert "`" not in page.partition("</style>")[2]


def test_the_rival_of_a_mask_is_the_grey_filter_of_its_least_suppressed_laser():
    (text,) = run_summary.rival({"410 nm": 0.0012, "690 nm": 0.0022}, {}).values()
    assert (
        text == "A grey filter that passes 0.0022 of the light weakens the laser as much: for its"
        " picture, restored alike, run this recipe with doe=grey_filter"
        " doe.transmittance=0.0022."
    )
    assert run_summary.rival({}, {}) == run_summary.rival({"530 nm": 0.95}, {}) == {}


def test_the_rival_has_the_quality_of_its_own_picture_if_the_run_computed_it():
    filtered = {"PSNR (dB)": 20.14, "saturated px": 0.0}
    numbers = {"grey filter, restored": filtered, "restored": {"PSNR (dB)": 17.67}}
    opening = (
        "A grey filter that passes 0.00149 of the light weakens the laser as much: its picture,"
        " restored by a "
    )
    end = "(doe=grey_filter doe.transmittance=0.00149)."
    assert run_summary.rival(GREEN, numbers) == {
        "rival": (
            f"{opening}Wiener filter, has a PSNR of 20.1 dB against 17.7 dB behind the mask; "
            f"no pixel saturates {end}"
        )
    }
    alone = {"grey filter, restored": {"PSNR (dB)": 12.0, "saturated px": 1234.0}}
    assert run_summary.rival(GREEN, alone)["rival"].endswith(
        f"a PSNR of 12.0 dB; 1,234 pixels saturate {end}"
    )


@pytest.mark.parametrize(
    ("doe", "name", "plural"),
    [
        ("grey_filter", "grey filter", False),
        ("small_stop", "smaller stop", False),
        ("notch", "notch filter", False),
        ("stop_and_filter", "smaller stop and grey filter", True),
        ("axicon_and_notch", "mask and notch filter", True),
        ("flat", "flat plate", False),
        ("axicon", "mask", False),
    ],
)
def test_the_story_names_what_stands_in_place_of_a_mask(doe, name, plural):
    assert run_summary.element(load("first_light", [f"doe={doe}"])) == name
    numbers = {"plain lens": PLAIN, "with mask": MASK, "restored": {}}
    found = sentences(numbers, GREEN, True, name)
    assert found["buys"].startswith(
        f"The {name} {'lower' if plural else 'lowers'} the peak on the sensor"
    )
    assert found["costs"].startswith(
        f"The {name} {'cost' if plural else 'costs'} picture quality: PSNR 27.1 dB with"
    )
    assert (
        f"14.6 dB with the {name}; 418 pixels saturate with the {name}, 244 without: the {name} enl"
        in found["costs"]
    )


def test_the_rival_is_computed_where_a_run_tells_of_a_mask_and_a_restored_picture():
    rival = {"rival_quality", "rival_saturated"}
    assert rival <= set(wanted(load("first_light")))
    assert not rival & set(wanted(load("first_light", ["doe=grey_filter"])))  # that is the rival
    assert not rival & set(wanted(load("first_light", ["outputs=[restored_quality]"])))
    assert not rival & set(wanted(load("six_lasers")))
