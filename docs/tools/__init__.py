"""What writes pages and figures of docs/ from the code and from shipped data."""
