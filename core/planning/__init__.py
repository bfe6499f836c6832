"""What a site as drawn will see, and how well."""
