"""Pictures of a run: its learning curve and a film of its policy."""
