"""The panel: a wall seen, felt and changed from a page in the browser."""
