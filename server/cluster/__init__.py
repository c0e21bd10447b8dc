"""The processes of a world on many processes: edges, sequencers and standbys on a bus (docs/scale.md). Adapters."""
