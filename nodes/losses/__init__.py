"""Losses: what learning minimises."""

from neusee.nodes.losses._contrast import contrast
from neusee.nodes.losses._mask import bsr, lsr
from neusee.nodes.losses._penalty import gradient_penalty
from neusee.nodes.losses._relative import mrae
from neusee.nodes.losses._restoration import charbonnier, fft_l1
from neusee.nodes.losses._wiener import wiener

__all__ = ["bsr", "charbonnier", "contrast", "fft_l1", "gradient_penalty", "lsr", "mrae", "wiener"]
