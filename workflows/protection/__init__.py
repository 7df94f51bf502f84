"""At equal protection of the sensor, what do a mask, a grey filter and a smaller stop leave of a
picture?

Measures of the picture behind each of them, for a quiet frame and under attack, each computed once.
Offers: `protection_camera.ProtectionCamera`, `equal_rivals.Rival`,
        `protection_result.measure_protection`.
"""
