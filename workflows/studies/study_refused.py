"""Error for a study that has nothing to study, raised before anything long runs."""


class StudyRefused(ValueError):
    """Error for a study whose recipe or options leave nothing to study; the message names the remedy."""
