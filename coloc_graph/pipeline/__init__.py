"""From a run to an estimate, in batch and incrementally; inspection of runs."""
