"""What keeps a record: its files, the thread that fills them, and what they tell of the session. For any process that records."""
