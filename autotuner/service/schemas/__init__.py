"""Schemas of the API as pydantic models: requests, resources, views."""
