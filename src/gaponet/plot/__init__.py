"""The ground floor of every figure: names and colours of methods, style, charts, legends, files."""
