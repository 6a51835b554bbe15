"""Plants, sensors and faults that only the checkout needs: effects outside the catalogue, a motor,
linear systems."""
