//go:build tools

// Names the program whose version go.mod pins.
package tools

import _ "k8s.io/kubernetes/cmd/kube-apiserver"
