"""The database's schema, step by step. Apply with ``fluoromap db upgrade``; a new step: see CONTRIBUTING.md."""
