"""Problems that other people published, planned by this project beside their own figures."""
