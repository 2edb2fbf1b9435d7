"""The endpoints, a module a resource.

Invariant: annotations are not postponed, because the framework reads them when it runs.
"""
