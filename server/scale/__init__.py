"""One world on many processes: a sequencer, edges and standbys, joined by one log (docs/scale.md)."""
