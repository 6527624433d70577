"""Pictures of worlds for renderers of others."""
