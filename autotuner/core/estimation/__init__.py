"""The fitting engine: data, zero-order-hold responses, variable projection, optimiser, covariance, noise models."""
