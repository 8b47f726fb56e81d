"""Text exports of scanning vibrometers."""
