"""Reports: figures and one self-contained HTML file."""
