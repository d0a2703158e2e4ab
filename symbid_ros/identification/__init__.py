"""From a log to an estimate, for arrays, bags and live topics alike."""
