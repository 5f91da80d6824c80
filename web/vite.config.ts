import { defineConfig } from "vite";

// `npm run dev` forwards the API to a server that runs beside it: tutelage serve ... --port 8800
const server = "http://127.0.0.1:8800";

export default defineConfig({
  build: {
    outDir: "../src/tutelage/console/static",
    emptyOutDir: true,
    assetsInlineLimit: 0, // the content security policy allows no data: scripts or styles
    modulePreload: { polyfill: false },
    rollupOptions: {
      output: {
        entryFileNames: "assets/console-[hash].js",
        chunkFileNames: "assets/[name]-[hash].js",
        assetFileNames: "assets/[name]-[hash][extname]",
      },
    },
  },
  server: {
    proxy: { "/api": { target: server, ws: true, changeOrigin: true } },
  },
});
