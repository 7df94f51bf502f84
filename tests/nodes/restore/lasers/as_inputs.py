"""The own camera as the inputs of the nodes: the only place where tests of the search use both."""

import numpy as np
import torch

from neusee.nodes import restore
from neusee.nodes.restore.lasers import Lens, line_templates
from neusee.nodes.values import Bands, Psf, Pupil
from tests.nodes.restore.lasers import own_camera as own

LENS = {"focal_length": own.FOCAL, "pixel_pitch": own.PITCH}


def tensor(x):
    return torch.as_tensor(np.ascontiguousarray(x))


BANDS = Bands(
    tensor(own.BANDS),
    torch.full((31,), 1e-8, dtype=torch.float64),
    torch.ones(31, dtype=torch.float64),
)


def pupil_of(mask, kind=torch.float32):
    """The pupil of a mask in all bands of the scene."""
    inside, height = (tensor(x).to(kind) for x in own.pupil(mask))
    pitch = torch.tensor(own.DIAMETER / own.SAMPLES, dtype=torch.float64)
    return Pupil(
        inside,
        inside.clone(),
        height,
        0 * height,
        tensor(own.silica(own.BANDS)),
        BANDS.centres,
        pitch,
    )


def inputs(frame, mask):
    """The inputs of `restore.find_lasers`."""
    psf = Psf(
        tensor(own.scene_psf(mask, frame.electrons.shape[-1] + 1)),
        torch.ones(31, dtype=torch.float64),
    )
    seen = (tensor(frame.electrons).float(), tensor(frame.clipped), psf, pupil_of(mask))
    return (*seen, tensor(own.daylight(own.BANDS)), tensor(own.band_response()), BANDS)


def found_in(frame, mask, **how):
    """What the node finds in a frame."""
    return restore.find_lasers(*inputs(frame, mask), read_noise=own.READ, **LENS, **how)


def kept_templates(mask, side):
    """The patterns on the axis of a mask, which are the same for every frame of a size."""
    with torch.no_grad():
        responses = tensor(own.band_response())
        return line_templates(
            pupil_of(mask), responses, BANDS, Lens(own.FOCAL, own.PITCH, (side, side))
        )
