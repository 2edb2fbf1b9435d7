"""The endpoints, a module a resource.

Rule of this package: annotations are not postponed, because the framework reads them when it runs.
"""
