"""The quantities of EMVA 1288, release 4.0 Linear, from frames in NumPy alone, which shares no code
with the nodes.

``quantities(pairs, series)`` takes a list of (photons, exposure in s, two frames) and the dark and
the lit series (frame, y, x), and gives the quantities by the keys of `emva_sheet`.
"""

import numpy as np


def quantities(pairs, series):
    """Every quantity by its key, as the equations of the standard have them."""
    rows = np.array([(p, t, *_moments(*np.asarray(frames, float))) for p, t, frames in pairs])
    dark = rows[rows[:, 0] == 0]
    dark = dark[np.argsort(dark[:, 1])]
    lit = rows[rows[:, 0] > 0]
    lit = lit[np.argsort(lit[:, 0])]
    own = np.array([dark[np.abs(dark[:, 1] - t).argmin()] for t in lit[:, 1]])
    mu_p, y, s2 = lit[:, 0], lit[:, 2] - own[:, 2], lit[:, 3] - own[:, 3]
    full = lit[:, 3].argmax()
    fit = y <= 0.7 * y[full]
    k, r = (
        np.linalg.lstsq(x[fit, None], z[fit], rcond=None)[0][0] for x, z in ((y, s2), (mu_p, y))
    )
    slopes = [np.polyfit(dark[:, 1], dark[:, i], 1) for i in (2, 3)]
    sigma, eta, most = np.sqrt(slopes[1][1]), r / k, mu_p[full]
    least = (sigma / k + 0.5) / eta
    fit = (y >= 0.05 * y[full]) & (y <= 0.95 * y[full])
    line = np.polyfit(mu_p[fit], y[fit], 1, w=1 / y[fit])
    apart = 100 * (y[fit] / np.polyval(line, mu_p[fit]) - 1)
    found = {
        "K": k, "inverse_K": 1 / k, "R": r, "eta": 100 * eta, "sigma_y_dark": sigma,
        "sigma_d": np.sqrt(sigma**2 - 1 / 12) / k, "mu_y_dark": dark[0, 2], "mu_d": dark[0, 2] / k, "mu_p_min": least,
        "mu_e_min": eta * least, "mu_p_sat": most, "mu_e_sat": eta * most, "SNR_max": np.sqrt(eta * most),
        "SNR_max_dB": 10 * np.log10(eta * most), "SNR_max_bit": np.log2(eta * most) / 2, "DR": most / least,
        "DR_dB": 20 * np.log10(most / least), "DR_bit": np.log2(most / least),
        "LE_min": apart.min(), "LE_max": apart.max(), "mu_I_mean": slopes[0][0] / k, "mu_I_var": slopes[1][0] / k**2,
    }  # fmt: skip
    below, above = (_spatial(np.asarray(stack, float)) for stack in series)
    signal = np.mean(series[1]) - np.mean(series[0])
    for name in below:
        end = "" if name == "total" else f"_{name}"
        found[f"DSNU1288{end}_DN"] = _root(below[name])
        found[f"DSNU1288{end}"] = _root(below[name]) / k
        found[f"PRNU1288{end}"] = 100 * _root(above[name] - below[name]) / signal
    return found


def _moments(one, two):
    """Mean, and variance in time without the difference of the means."""
    apart = one - two
    return (one.mean() + two.mean()) / 2, ((apart**2).mean() - apart.mean() ** 2) / 2


def _spatial(stack):
    """Spatial variances: the three equations of the standard for rows, columns and pixels,
    solved.
    """
    count, rows, columns = stack.shape
    image, left = stack.mean(0), stack.var(0, ddof=1).mean() / count
    total = image.var(ddof=1) - left
    known = [total, image.mean(1).var() - left / columns, image.mean(0).var() - left / rows]
    parts = np.linalg.solve([[1, 1, 1], [1, 0, 1 / columns], [0, 1, 1 / rows]], known)
    return {"total": total, **dict(zip(("row", "column", "pixel"), parts, strict=True))}


def _root(variance):
    return np.sqrt(variance) if variance > 0 else np.nan
