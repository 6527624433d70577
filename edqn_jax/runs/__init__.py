"""What a run keeps on disk: its directory, its policy, its provenance; files written atomically."""
