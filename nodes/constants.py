"""Physical constants, exact by definition in the SI of 2019 (CODATA).

Colour-science rounds the Planck constant to six digits.
"""

PLANCK = 6.626_070_15e-34  #: J s
SPEED_OF_LIGHT = 299_792_458.0  #: m/s
ELEMENTARY_CHARGE = 1.602_176_634e-19  #: C
