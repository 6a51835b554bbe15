"""The pages, and in `tools` what makes some of them from the code. No part of the package."""
