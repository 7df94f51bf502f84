"""Refusal of sensors that cannot record light: the dark signal fills the well, or the converter has no steps for it."""

from neusee.nodes import ParameterError


def refuse_without_room(
    full_well: float, *, well: str = "full_well", offset: float = 0.0, read_noise: float = 0.0, dark: float = 0.0
) -> None:
    """Raise ParameterError for a sensor whose pixels have no room for light.

    The offset and the electrons of the dark current together must be below the full well, and so must the read noise.
    Errors name the parameter ``well``, in which the node has its full well, or read_noise.

    Shapes: scalars.
    Units:  electrons.
    Source: EMVA Standard 1288, release 4.0: the saturation capacity counts from the dark value.
    """
    if offset + dark >= full_well:
        parts = [f"the offset of {offset:.6g} e-"] * (offset > 0) + [f"the dark current of {dark:.6g} e-"] * (dark > 0)
        text = f"{' and '.join(parts)} fill{'s' * (len(parts) == 1)} a full well of {full_well:.6g} e- without light"
        raise ParameterError(well, f"{text}: no exposure could be recorded")
    if read_noise >= full_well:
        text = f"a read noise of {read_noise:.6g} e- is not below the full well of {full_well:.6g} e-"
        raise ParameterError("read_noise", f"{text}: no exposure could be told from the dark")


def refuse_without_steps(full_well: float, *, gain: float, bits: int) -> None:
    """Raise ParameterError for a converter that has no step for light: a full well below half a digital number.

    Shapes: scalars.
    Units:  full_well e-; gain DN/e-.
    Source: EMVA Standard 1288, release 4.0: the linear model y = K e- + offset, rounded.
    """
    if full_well * gain < 0.5:
        text = f"a gain of {gain:.4g} DN/e- turns a full well of {full_well:.6g} e- into {full_well * gain:.3g} DN"
        raise ParameterError("gain", f"{text}: every picture would be 0 DN")
    refuse_below_one_electron(gain=gain, bits=bits)


def refuse_below_one_electron(*, gain: float, bits: int) -> None:
    """Raise ParameterError for a converter of ``bits`` that ends below one electron, so that one electron clips it."""
    largest = ((1 << bits) - 1) / gain
    if largest < 1:
        text = f"with a gain of {gain:.4g} DN/e- the largest digital number of {bits} bits is {largest:.3g} e-"
        raise ParameterError("gain", f"{text}: a single electron would clip a pixel")
