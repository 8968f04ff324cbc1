"""Parts of the controller node: joints and services, published topics, rivals."""
