"""HTML reports of an evaluation: tables, curves, pictures."""
