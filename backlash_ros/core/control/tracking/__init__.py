"""The structure that makes y follow y_m: gains, preview, behaviour at rest."""
