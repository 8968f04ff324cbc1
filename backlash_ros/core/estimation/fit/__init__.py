"""The fit behind the default law: sides of the gap relabelled until they agree with it."""
