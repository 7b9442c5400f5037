"""The client's side of the arbiter's wire, sans-IO."""
