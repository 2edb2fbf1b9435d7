"""Process models: structures, parameters with units, and their exact responses."""
