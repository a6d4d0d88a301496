"""Questions: each trains or plays, and becomes tables, figures and sentences in one folder."""
