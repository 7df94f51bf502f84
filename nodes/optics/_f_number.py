"""Refusal of lenses that are faster than any lens in air."""

from neusee.nodes import ParameterError


def refuse_impossible_f_number(focal_length: float, diameter: float, parameter: str) -> None:
    """Raise ParameterError for a lens whose diameter is more than twice its focal length.

    The sine condition is diameter = 2 n f sin(angle), and no angle has a sine above 1.

    Shapes: scalars.
    Units:  metres.
    Source: Goodman, Introduction to Fourier Optics, 3rd edition, section 6.2; Born and Wolf, Principles of Optics, 4.5.
    """
    if diameter > 2 * focal_length * (1 + 1e-9):
        text = f"a diameter of {diameter * 1e3:.6g} mm with a focal length of {focal_length * 1e3:.6g} mm"
        raise ParameterError(parameter, f"{text} is f/{focal_length / diameter:.3g}: no lens in air is below f/0.5")
