"""The endpoints, a module a resource."""
