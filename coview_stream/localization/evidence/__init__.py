"""Evidence: what a scan says of a place, against chance (docs/integrity.md has the equations)."""
