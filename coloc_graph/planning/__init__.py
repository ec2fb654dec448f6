"""Plans of a leap-frog: where each robot stands, where the mover drives, and the uncertainty that this promises."""
