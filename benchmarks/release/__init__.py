"""What a release needs: shipped models, model cards, the README's tables."""
