"""Models of JSON replies: OpenAPI, the tests and the types of the map page come from them."""
