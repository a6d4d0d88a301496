"""The ground floor of every figure: style, charts, legends, files."""
