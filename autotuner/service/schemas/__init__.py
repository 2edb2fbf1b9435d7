"""What goes over the wire, as pydantic models: requests, resources, views."""
