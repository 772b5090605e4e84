"""The studio: reads run folders, writes nothing into them."""
