"""Chance without a seed of the recipe: nothing changes, and the next run should draw again or
say a word.
"""

from unseen_kinds.case import Case


def draws(name: str, about: str, lines: str) -> Case:
    """Return a case whose node runs a few lines that return a number."""
    indented = "\n".join("    " + line for line in lines.strip("\n").splitlines())
    return Case(
        name, about, f"@node()\ndef value(*, scale: float = 100.0) -> Tensor:\n{indented}\n"
    )


CASES = [
    draws("torch_poisson", "shot noise", "return torch.poisson(torch.full((20, 20), scale))"),
    draws(
        "default_rng", "a generator of NumPy", "return picture(np.random.default_rng().normal())"
    ),
    draws(
        "scipy_rvs",
        "a distribution of SciPy",
        """
from scipy import stats

return picture(stats.norm.rvs(scale=scale))
""",
    ),
    draws(
        "random_state_of_numpy",
        "the old generator under another name",
        """
draw = np.random.mtrand.RandomState

return picture(draw().rand())
""",
    ),
    draws("bernoulli_", "an in-place draw", "return torch.empty(20, 20).bernoulli_(0.5)"),
    draws(
        "multinomial", "torch.multinomial", "return torch.multinomial(torch.ones(1000), 10).float()"
    ),
    draws(
        "dropout",
        "a dropout that nobody switched off",
        """
return torch.nn.functional.dropout(torch.ones(20, 20))
""",
    ),
    draws(
        "skimage_noise",
        "skimage.util.random_noise",
        """
from skimage.util import random_noise

return torch.as_tensor(random_noise(np.zeros((4, 4)), "gaussian", clip=False))
""",
    ),
    draws(
        "random_graph",
        "a graph of networkx without a seed",
        """
import networkx

return picture(networkx.gnp_random_graph(100, 0.5).number_of_edges())
""",
    ),
    draws(
        "kornia_augmentation",
        "an augmentation of kornia",
        """
import kornia.augmentation

return kornia.augmentation.RandomGaussianNoise(p=1.0)(torch.zeros(1, 1, 4, 4))
""",
    ),
]
