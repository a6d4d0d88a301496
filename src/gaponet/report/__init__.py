"""Pictures of what was measured: reports, figures, pages and the viewer."""
