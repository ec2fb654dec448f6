"""From a run to an estimate: in batch, incrementally, and what is wrong with a run."""
