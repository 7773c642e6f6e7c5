"""Evidence of a scan for a place, against chance (docs/integrity.md has the equations)."""
