"""Marker tracks in one camera: tracking, blink codes, marker pairs, interpolation."""
