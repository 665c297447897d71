"""What a codec, link, driver, session, action and publisher promise."""
