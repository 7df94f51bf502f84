"""At equal protection of the sensor, does a mask give a better picture than a filter or a smaller stop?

The study compares the recipe's mask with what anyone can buy, for a quiet frame and under attack.
Offers: `protection_study.study`, `camera_parts.ProtectionCamera`, `equal_rivals.Rival`.
"""
