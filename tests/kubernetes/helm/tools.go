//go:build tools

// Names the program whose version go.mod pins.
package tools

import _ "helm.sh/helm/v3/cmd/helm"
